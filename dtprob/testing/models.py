"""The contract of a model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro

from dtprob.inference.build import build_target
from dtprob.inference.target import Inputs, Target
from dtprob.models.arguments import Model
from dtprob.models.axes import is_unnamed
from dtprob.models.declaration import Declaration, declare
from dtprob.models.execution import trace_model
from dtprob.models.supported import differentiated_forwards
from dtprob.testing.contract import expect, same

_POINTS = 8


def check_model(model: Model, data: Mapping[str, Any], *, key: jax.Array | None = None) -> None:
    """Check that a NumPyro model is one that engines, effects and reports can use.

    It declares itself on the data; every axis has a name; without its observations it draws from the prior
    predictive, in the data's shape and type; its log density and the gradient are finite at draws of the
    prior; the gradient agrees with finite differences; and the same key gives the same run.

    Args:
        model: a NumPyro model.
        data: its arguments by name, the observed ones present.
        key: typed JAX key; by default a fixed one.

    Raises:
        ContractError: the contract is broken.
        InputError: the data do not fit the model.
    """
    key = jax.random.key(0) if key is None else key
    declaration = declare(model, data)
    what = f"model {declaration.name}"
    _check_axes(what, declaration)
    with numpyro.validation_enabled(False):  # values that are not finite are for the checks to find
        _check_prior_predictive(what, model, data, declaration, key)
        _check_repeats(what, model, data, key)
        target, inputs = build_target(model, data)
        _check_density(what, target, inputs, key)


def _check_axes(what: str, declaration: Declaration) -> None:
    for name, site in declaration.sites.items():
        unnamed = [axis for axis, n in zip(site.axes, site.shape, strict=True) if is_unnamed(axis) and n > 1]
        remedy = f"Use plates, or the decorator @model(axes={{{name!r}: (...)}})"
        expect(not unnamed, what, f"a name for every axis of {name!r}", f"{len(unnamed)} without", remedy)


def _check_prior_predictive(
    what: str, model: Model, data: Mapping[str, Any], declaration: Declaration, key: jax.Array
) -> None:
    arguments = {site.argument for site in declaration.observed.values()}
    remedy = "Let the observed argument default to None, and give it to numpyro.sample as obs"
    expect(None not in arguments, what, "observations that are arguments", "one made in the model", remedy)
    trace = trace_model(model, {name: value for name, value in data.items() if name not in arguments}, key)
    for name, site in declaration.observed.items():
        expect(name in trace, what, f"a prior draw of {name!r}", "no such site", remedy)
        drawn = np.asarray(trace[name]["value"])
        shapes = f"shape {site.shape}", str(drawn.shape)
        expect(drawn.shape == site.shape, f"{what}, prior draw of {name!r}", *shapes, "Size plates by inputs")
        kinds = ("complex", "real") if site.is_complex else ("real", "complex")
        agree = np.iscomplexobj(drawn) == site.is_complex
        expect(agree, f"{what}, prior draw of {name!r}", *kinds, "Observe what the distribution draws")
        expect(
            np.all(np.isfinite(drawn)), f"{what}, prior draw of {name!r}", "finite", "not", "Mend the prior"
        )


def _check_repeats(what: str, model: Model, data: Mapping[str, Any], key: jax.Array) -> None:
    first, second = (trace_model(model, data, key) for _ in range(2))
    for name, message in first.items():
        if message["type"] in ("sample", "deterministic"):
            again = same(message["value"], second[name]["value"])
            remedy = "Draw with numpyro.sample or numpyro.prng_key only"
            expect(again, what, f"the same {name!r} for the same key", "another", remedy)


def _check_density(what: str, target: Target, inputs: Inputs, key: jax.Array) -> None:
    points = target.compiled(Target.prior_draws)(key, inputs, {})[:_POINTS]
    with differentiated_forwards():
        target.compiled(_pushed)(points[0], inputs)
    function = target.compiled(_value_and_slope)
    direction = jax.random.normal(jax.random.fold_in(key, 1), (target.dimension,))
    direction /= jnp.linalg.norm(direction)
    step = float(jnp.finfo(direction.dtype).eps) ** (1 / 3)
    remedy = (
        "Keep the model finite over the whole prior; see where a division, a root or a logarithm can fail"
    )
    for point in points:
        value, slope = function(point, direction, inputs)
        expect(jnp.isfinite(value), what, "a finite log density at a prior draw", float(value), remedy)
        expect(jnp.isfinite(slope), what, "a finite gradient at a prior draw", float(slope), remedy)
    ahead, behind = (function(points[0] + s * direction, direction, inputs)[0] for s in (step, -step))
    value, slope = function(points[0], direction, inputs)
    numeric = float(ahead - behind) / (2 * step)
    rounding = 10 * float(jnp.finfo(direction.dtype).eps) * abs(float(value)) / step
    close = abs(numeric - float(slope)) <= 1e-3 * max(abs(numeric), abs(float(slope))) + rounding + 1e-6
    got = f"{float(slope):.6g} where differences give {numeric:.6g}"
    expect(close, what, "the gradient of the log density", got, "Look for a stopped gradient or a jump")


def _pushed(target: Target, point: jax.Array, inputs: Inputs) -> jax.Array:
    return jax.jvp(lambda x: target.log_density(x, inputs), (point,), (point,))[1]


def _value_and_slope(
    target: Target, point: jax.Array, direction: jax.Array, inputs: Inputs
) -> tuple[jax.Array, jax.Array]:
    value, gradient = jax.value_and_grad(target.log_density)(point, inputs)
    return value, jnp.where(jnp.all(jnp.isfinite(gradient)), gradient @ direction, jnp.nan)
