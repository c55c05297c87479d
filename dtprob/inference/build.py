"""From a model and data to a target: its checks, its coordinates and their units, what is compiled once."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dtprob.errors import InputError
from dtprob.inference.circular import mean_direction
from dtprob.inference.program import program_hash
from dtprob.inference.target import Coordinates, Inputs, Target, free_value
from dtprob.models.arguments import Data, Model, split_static
from dtprob.models.declaration import declare
from dtprob.models.execution import trace_model
from dtprob.models.supported import refuse_obs_mask, refuse_unsupported
from dtprob.xla import warn_of_miscompilation

_NORMAL_IQR = 1.349
_KEPT_TARGETS = 32


def build_target(model: Model, data: Data) -> tuple[Target, Inputs]:
    """The target of a model on data, and the arrays that its functions take.

    Data of the same shapes and settings give the same target object, so that what was compiled for one
    serves the other.

    Raises:
        InputError: the data do not fit the model; or the model has a discrete or complex latent site, a
            parameter site, a plate that subsamples, an obs_mask, or nothing latent; or NaN in the data reach its density.
    """
    warn_of_miscompilation()
    arrays, static = split_static(data)
    arrays = jax.tree.map(jnp.asarray, arrays)
    target = _TARGETS.get(model, arrays, static)
    bare = Inputs(arrays, jnp.zeros(target.dimension), jnp.ones(target.dimension))
    draws = target.once(Target.prior_draws)(jax.random.key(0), bare, {})
    inputs = Inputs(arrays, *prior_units(target, np.asarray(draws)))
    _refuse_nan(target, inputs)
    return target, inputs


def _refuse_nan(target: Target, inputs: Inputs) -> None:
    """Name an argument whose NaN leaves no density where finite numbers would; what a model masks may stay."""
    holes = {name: place for name, entry in inputs.arrays.items() if (place := _hole(entry)) is not None}
    if not holes:
        return
    filled = inputs._replace(arrays=jax.tree.map(_filled, inputs.arrays))
    density = target.once(Target.log_density)
    as_given, as_filled = (density(jnp.zeros(target.dimension), each) for each in (inputs, filled))
    if np.isfinite(as_filled) and not np.isfinite(as_given):
        name, place = next(iter(holes.items()))
        remedy = "Leave the reading out, or mask it with a finite number in its place"
        raise InputError(f"data {name!r}", "finite numbers", f"NaN at index {place}", remedy)


def _hole(entry: Any) -> list[int] | None:
    """Where an argument's first NaN is, if it has one."""
    for leaf in jax.tree.leaves(entry):
        if jnp.issubdtype(leaf.dtype, jnp.inexact) and (missing := np.isnan(np.asarray(leaf))).any():
            return np.argwhere(missing)[0].tolist()
    return None


def _filled(leaf: Array) -> Array:
    """An array with one of its own finite values in place of each NaN."""
    if _hole(leaf) is None:
        return leaf
    values = np.asarray(leaf)
    there = values[~np.isnan(values)]
    return jnp.asarray(np.where(np.isnan(values), there[0] if len(there) else 1.0, values), leaf.dtype)


def prior_units(target: Target, draws: np.ndarray) -> tuple[Array, Array]:
    """Location and scale of each coordinate, from draws of the prior, (draw, ..., dimension)."""
    with np.errstate(invalid="ignore"):
        low, middle, high = np.quantile(draws, [0.25, 0.5, 0.75], axis=0)
        spread = (high - low) / _NORMAL_IQR
        usable = np.isfinite(middle) & np.isfinite(spread) & (spread > 0)
    location = np.where(usable, middle, 0.0)
    scale = np.where(usable, spread, 1.0)
    direction = mean_direction(draws)
    return (
        jnp.asarray(np.where(target.circular, direction, location)),
        jnp.asarray(np.where(target.circular, 1.0, scale)),
    )


class _TargetCache:
    """The latest targets, by model, settings and shapes; a target goes with what was compiled for it.

    A model that reads something else, which has changed since (a global, an attribute), is another one.
    """

    def __init__(self) -> None:
        self._kept: OrderedDict[Any, tuple[Target, str]] = OrderedDict()

    def get(self, model: Model, arrays: dict[str, Any], static: dict[str, Any]) -> Target:
        signature = _signature(model, arrays, static)
        target, known = self._kept.get(signature, (None, ""))
        target = _make_target(model, arrays, static) if target is None else target
        program = _program(model, arrays, static)
        if known and known != program:
            target = _make_target(model, arrays, static)
        self._kept[signature] = target, program
        self._kept.move_to_end(signature)
        while len(self._kept) > _KEPT_TARGETS:
            self._kept.popitem(last=False)
        return target


_TARGETS = _TargetCache()


def _signature(model: Model, arrays: dict[str, Any], static: dict[str, Any]) -> Any:
    leaves, structure = jax.tree.flatten(arrays)
    settings, settings_structure = jax.tree.flatten(static)
    shapes = tuple((leaf.shape, str(leaf.dtype)) for leaf in leaves)
    known = tuple(_hashable(setting) for setting in settings)
    return model, structure, shapes, settings_structure, known, jax.config.jax_enable_x64


def _hashable(setting: Any) -> Any:
    """A setting, or which object it is where it cannot be hashed, as a dataclass of arrays; its target keeps it alive."""
    try:
        hash(setting)
    except TypeError:
        return type(setting), id(setting)
    return setting


def _program(model: Model, arrays: dict[str, Any], static: dict[str, Any]) -> str:
    """Hash of what a run of the model computes, constants included."""

    def run(arrays: dict[str, Any], key: Array) -> list[Any]:
        trace = trace_model(model, eqx.combine(arrays, static), key)
        samples = [site for site in trace.values() if site["type"] == "sample"]
        densities = [site["fn"].log_prob(site["value"]) for site in samples]
        scales = [site["scale"] for site in samples if site["scale"] is not None]
        others = [site["value"] for site in trace.values() if site["type"] == "deterministic"]
        return [*densities, *scales, *others]

    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), arrays)
    return program_hash(jax.make_jaxpr(run)(shapes, jax.random.key(0)))


def _make_target(model: Model, arrays: dict[str, Any], static: dict[str, Any]) -> Target:
    declaration = declare(model, eqx.combine(arrays, static), needs="weight")
    shapes = _unconstrained_shapes(model, arrays, static)
    if not declaration.latent:
        remedy = "Sample at least one unknown with numpyro.sample"
        raise InputError(f"model {declaration.name}", "a latent site", "none", remedy)
    refuse_obs_mask(declaration)
    coordinates: dict[str, Coordinates] = {}
    start = 0
    for name, site in declaration.latent.items():
        stop = start + int(np.prod(shapes[name], dtype=int))
        coordinates[name] = Coordinates(start, stop, shapes[name], site.is_circular)
        start = stop
    circular = np.zeros(start, dtype=bool)
    for place in coordinates.values():
        circular[place.start : place.stop] = place.is_circular
    return Target(model, declaration, coordinates, static, circular)


def _unconstrained_shapes(
    model: Model, arrays: dict[str, Any], static: dict[str, Any]
) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}

    def run(traced: dict[str, Any], key: Array) -> None:
        trace = trace_model(model, eqx.combine(traced, static), key)
        for name, message in trace.items():
            refuse_unsupported(model, name, message)
            if message["type"] == "sample" and not message["is_observed"]:
                shapes[name] = tuple(jnp.shape(free_value(message)))

    jax.eval_shape(run, arrays, jax.random.key(0))
    return shapes
