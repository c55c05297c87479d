"""One model on many small data sets: all their chains side by side in one program."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dtprob.errors import InputError, unknown_name
from dtprob.inference.assemble import (
    Kept,
    block_size,
    independent_stats,
    kept_sites,
    observed_sites,
    provenance,
    push,
)
from dtprob.inference.build import build_target, prior_units
from dtprob.inference.chains import stacked_axes
from dtprob.inference.engine import DEFAULT, AbstractEngine, RunOptions, check_key
from dtprob.inference.fit import resolve
from dtprob.inference.hamiltonian import AbstractHamiltonian
from dtprob.inference.laplace import Laplace, approximate
from dtprob.inference.modes import search, starting_points
from dtprob.inference.posterior import Posterior, Values
from dtprob.inference.run import Loop
from dtprob.inference.target import Inputs, Target
from dtprob.models.arguments import Model
from dtprob.models.indices import check_indices
from dtprob.models.support import check_support


def fit_each(
    model: Model,
    data: Mapping[str, Any],
    own: Sequence[str],
    *,
    axis: str = "member",
    engine: str | AbstractEngine = "laplace",
    key: jax.Array,
    options: RunOptions = DEFAULT,
    **settings: Any,
) -> Posterior:
    """Infer a model's latent sites from each of many data sets of the same shapes, apart from each other.

    Each is fitted by itself, chains with a step size and a mass matrix of their own, as if `fit` had been called for
    each with the keys fold_in(key, 0), fold_in(key, 1), ...: the same draws but for rounding. "laplace" gains most by
    that: what a call costs on the host is paid once. Chains of "hmc" gain nearly as much; those of "nuts" and
    "blackjax_nuts" wait for the longest trajectory among them.

    Args:
        model: a NumPyro model.
        data: its arguments by name.
        own: those of which each data set has its own, stacked on a leading axis; the others are shared.
        axis: name of that axis in the posterior, where it follows the chains and draws: (chain, draw, member, *event).
        engine: "laplace", "hmc", "nuts" or "blackjax_nuts", by name or set up.
        key: typed JAX key.
        options: progress (of chains), what to keep; there is no checkpoint.
        settings: the engine's own, such as `draws`.

    Raises:
        InputError: see `fit`; or another engine, an early stop, a checkpoint, or stacks of several lengths.
    """
    chosen = _checked(resolve(engine, **settings), options)
    check_key(key)
    count = _count(data, own)
    for number in _outermost(data, own, count):
        check_indices(model, _member(data, own, number), f"data set {number}")
    check_support(model, data, "data sets", own)
    target, members = _members(model, data, own, count)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(count))
    if isinstance(chosen, Laplace):
        drawn, extra = _approximated(target, members, tuple(own), keys, chosen)
    else:
        drawn, extra = _walked(target, members, tuple(own), keys, chosen, options), {}
    return _posterior(
        target, members, own, drawn, axis=axis, engine=chosen, key=key, options=options, extra=extra
    )


def _approximated(
    target: Target, inputs: Inputs, own: tuple[str, ...], keys: Array, engine: Laplace
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws of the normal approximation of each, (member, 1, draw, dimension), and how the searches went."""
    values = target.latent_values(engine.initial or {})
    found = target.compiled(_gaussians, own, engine.starts, engine.max_steps, engine.draws)(
        keys, values, inputs
    )
    positions, facts = jax.tree.map(np.asarray, found)
    if not np.isfinite(facts["log_density"]).all():
        got = f"none at any start of data set {int(np.argmin(np.isfinite(facts['log_density'])))}"
        remedy = "Give initial values, or check that the data are finite and within the model's supports"
        raise InputError(f"model {target.declaration.name}", "a finite log density", got, remedy)
    return {"position": positions[:, None]}, facts


def _gaussians(  # noqa: PLR0917
    target: Target,
    own: tuple[str, ...],
    starts: int,
    max_steps: int,
    draws: int,
    keys: Array,
    values: dict[str, Array],
    inputs: Inputs,
) -> tuple[Array, dict[str, Array]]:
    count = 1 if len(values) == len(target.coordinates) else starts

    def one(key: Array, arrays: Inputs) -> tuple[Array, dict[str, Array]]:
        search_key, draw_key = jax.random.split(key)
        points = starting_points(target, arrays, search_key, objective="density", values=values, starts=count)
        mode = search(target, "density", max_steps, points, arrays)
        gaussian = approximate(target, mode.optimum.position, arrays)
        noise = jax.random.normal(draw_key, (draws, target.dimension))
        names = ("log_density", "log_evidence", "replaced")
        facts = mode.facts() | {name: getattr(gaussian, name) for name in names}
        return gaussian.mode + noise @ gaussian.factor.T, facts

    return jax.vmap(one, in_axes=(0, stacked_axes(inputs, own)))(keys, inputs)


def _walked(  # noqa: PLR0917
    target: Target,
    inputs: Inputs,
    own: tuple[str, ...],
    keys: Array,
    engine: AbstractHamiltonian,
    options: RunOptions,
) -> dict[str, np.ndarray]:
    """Draws and statistics of the chains of each, (member, chain, draw, ...)."""
    schedule = replace(engine.schedule(), method="vectorized")
    count, chains = len(keys), jnp.arange(engine.chains)
    each = jax.vmap(lambda k: jax.vmap(jax.random.fold_in, (None, 0))(k, chains))(keys).reshape(-1)
    taken = _taken(inputs, own, np.repeat(np.arange(count), engine.chains))
    walk = schedule.walk(target, engine.kernel, own)
    found = Loop(target, taken, walk, schedule, keys[0], options, engine).run(each)
    return {name: x.reshape(count, engine.chains, *x.shape[1:]) for name, x in found.items()}


def _checked(engine: AbstractEngine, options: RunOptions) -> AbstractHamiltonian | Laplace:
    what = f"fit_each with engine {engine.name}"
    if not isinstance(engine, AbstractHamiltonian | Laplace):
        remedy = "Call fit for each data set; what is compiled for the first serves the others"
        raise InputError(what, "laplace, hmc, nuts or blackjax_nuts", engine.name, remedy)
    if not isinstance(engine, Laplace) and engine.enough_ess:
        raise InputError(what, "no early stop", f"enough_ess {engine.enough_ess}", "Leave enough_ess at 0")
    if options.checkpoint is not None:
        raise InputError(what, "no checkpoint", str(options.checkpoint), "Fit fewer data sets at once")
    return engine


def _count(data: Mapping[str, Any], own: Sequence[str]) -> int:
    """How many data sets there are."""
    for name in own:
        if name not in data:
            raise unknown_name("own of fit_each", name, data, "argument")
    leaves = jax.tree.leaves([data[name] for name in own])
    lengths = {np.shape(leaf)[:1] for leaf in leaves}
    if len(lengths) != 1 or lengths <= {(), (0,)}:
        got = ", ".join(str(length[0]) if length else "a scalar" for length in sorted(lengths)) or "nothing"
        remedy = "Stack the data sets on the first axis of each of their arrays"
        raise InputError("arrays named in own of fit_each", "one common length, 1 or more", got, remedy)
    return int(np.shape(leaves[0])[0])


def _member(data: Mapping[str, Any], own: Sequence[str], number: int) -> dict[str, Any]:
    """The data set of this number."""
    return {n: jax.tree.map(lambda x: np.asarray(x)[number], v) if n in own else v for n, v in data.items()}


def _outermost(data: Mapping[str, Any], own: Sequence[str], count: int) -> list[int]:
    """Data sets that hold the largest or the smallest index of any column: where none is beyond an array, none is."""
    columns = [np.asarray(leaf) for leaf in jax.tree.leaves([data[name] for name in own])]
    whole = [column.reshape(count, -1) for column in columns if column.dtype.kind in "iu" and column.size]
    found = [(int(w.max(axis=1).argmax()), int(w.min(axis=1).argmin())) for w in whole]
    return sorted({0, *(number for pair in found for number in pair)})


def _members(model: Model, data: Mapping[str, Any], own: Sequence[str], count: int) -> tuple[Target, Inputs]:
    """The target of any of the data sets, and their inputs: own arrays and units stacked."""
    target, inputs = build_target(model, _member(data, own, 0))
    stacked = {name: jax.tree.map(jnp.asarray, data[name]) for name in own}
    bare = Inputs(inputs.arrays | stacked, *(jnp.zeros((count, target.dimension)) + i for i in range(2)))
    keys = jnp.broadcast_to(jax.random.key(0), (count,))
    draws = target.compiled(_prior_draws, tuple(own))(keys, bare)
    return target, Inputs(bare.arrays, *prior_units(target, np.moveaxis(np.asarray(draws), 0, 1)))


def _prior_draws(target: Target, own: tuple[str, ...], keys: Array, inputs: Inputs) -> Array:
    draw = functools.partial(target.prior_draws, values={})
    return jax.vmap(draw, in_axes=(0, stacked_axes(inputs, own)))(keys, inputs)


def _taken(inputs: Inputs, own: Sequence[str], index: Any) -> Inputs:
    """The inputs of the data sets of these numbers, or of one."""
    arrays = {n: jax.tree.map(lambda x: x[index], v) if n in own else v for n, v in inputs.arrays.items()}
    return Inputs(arrays, inputs.location[index], inputs.scale[index])


def _posterior(
    target: Target,
    inputs: Inputs,
    own: Sequence[str],
    drawn: dict[str, np.ndarray],
    *,
    axis: str,
    engine: AbstractEngine,
    key: jax.Array,
    options: RunOptions,
    extra: dict[str, np.ndarray],
) -> Posterior:
    """The posterior of draws (member, chain, draw, ...), the members on an axis after the draws."""
    positions = drawn.pop("position")
    count, chains, draws, _ = positions.shape
    first = _taken(inputs, own, 0)
    shapes = jax.eval_shape(target.compiled(Target.evaluate), positions[0, 0, 0], first)
    kept, left_out = kept_sites(target, shapes, options, count * chains * draws)
    has_lp, size = "lp" in drawn, block_size(shapes)
    values, pointwise, lp = _pushed(target, inputs, tuple(own), positions, kept, size, has_lp=has_lp)
    declaration = target.declaration
    sites = [name for name in declaration.sites if name in values]
    stats = independent_stats(lp) | {name: np.moveaxis(value, 0, 2) for name, value in drawn.items()}
    observed = target.compiled(_observed_each, tuple(own))(inputs)
    known = provenance(target, inputs, engine, key)
    return Posterior(
        draws={name: values[name] for name in sites},
        sample_stats=stats,
        log_likelihood=pointwise,
        observed=jax.tree.map(np.asarray, observed),
        axes=dict.fromkeys(stats, (axis,))
        | {name: (axis, *site.axes) for name, site in declaration.sites.items()},
        latent=tuple(target.coordinates),
        circular=tuple(name for name in sites if declaration.sites[name].is_circular),
        extra=extra,
        provenance=known | {"left_out": left_out, "own": list(own)},
    )


def _pushed(  # noqa: PLR0917
    target: Target,
    inputs: Inputs,
    own: tuple[str, ...],
    positions: Float[np.ndarray, "member chain draw dimension"],
    kept: Kept,
    block: int,
    *,
    has_lp: bool,
) -> tuple[Values, Values, np.ndarray]:
    """Values, pointwise log likelihoods and log densities, each (chain, draw, member, ...)."""
    count, chains, draws, dimension = positions.shape
    flat = positions.reshape(count, -1, dimension)
    through = target.compiled(_push_each, kept, has_lp, own)
    blocks = [
        jax.tree.map(np.asarray, through(flat[:, begin : begin + block], inputs))
        for begin in range(0, flat.shape[1], block)
    ]

    def laid_out(*parts: np.ndarray) -> np.ndarray:
        whole = np.concatenate(parts, axis=1)
        return np.moveaxis(whole.reshape(count, chains, draws, *whole.shape[2:]), 0, 2)

    return jax.tree.map(laid_out, *blocks)


def _push_each(  # noqa: PLR0917
    target: Target, kept: Kept, has_lp: bool, own: tuple[str, ...], positions: Array, inputs: Inputs
) -> Any:
    axes = (0, stacked_axes(inputs, own))
    return jax.vmap(functools.partial(push, target, kept, has_lp), in_axes=axes)(positions, inputs)


def _observed_each(target: Target, own: tuple[str, ...], inputs: Inputs) -> dict[str, Array]:
    return jax.vmap(functools.partial(observed_sites, target), in_axes=(stacked_axes(inputs, own),))(inputs)
