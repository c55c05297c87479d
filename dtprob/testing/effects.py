"""The contract of an effect."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro import handlers

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.effects.redrawn import drawn_apart
from dtprob.effects.rewriting import Rewriting, may_become
from dtprob.gap.model.whole_numbers import real_sites
from dtprob.models.arguments import Model, as_arrays, within
from dtprob.testing.contract import expect, same

type Trace = Mapping[str, Mapping[str, Any]]

_DRAWS = 200


def check_effect(
    effect: Effect, model: Model, data: Mapping[str, Any], *, key: jax.Array | None = None
) -> None:
    """Check that an effect is one that a diagnosis can use on a model.

    It says its physics and units; its sites are the model's; at its null the run of the model is
    unchanged, bit for bit; away from it shapes and types stay and values are finite; its derivative at the
    null agrees with finite differences; its priors are proper and reach the null.

    Args:
        effect: the effect.
        model: a NumPyro model that has the effect's sites.
        data: the model's arguments by name.
        key: typed JAX key; by default a fixed one.

    Raises:
        ContractError: the contract is broken.
    """
    key = jax.random.key(0) if key is None else key
    what = f"effect {effect.name}"
    remedy = "Say in a line what it is: the report shows it beside the cause"
    expect(effect.physics, what, "a text for 'physics'", "none", remedy)
    for parameter in effect.parameters:
        _check_parameter(f"{what}, parameter {parameter.name!r}", parameter, key)
    with numpyro.validation_enabled(False):  # values that are not finite are for the checks to find
        whole = real_sites(model, as_arrays(data))  # as a diagnosis takes it
        model = within(whole, lambda: drawn_apart(effect.rewrites))
        plain = _run(model, data, key)
        for site in effect.sites:
            remedy = "Give it to models that have it"
            expect(site in plain, what, f"a site {site!r} of the model", "none", remedy)
        for site in effect.rewrites:
            got, remedy = "one that is observed", "Replace its distribution: distributions, not rewrites"
            expect(not plain[site].get("is_observed"), what, f"a value {site!r} to rewrite", got, remedy)
        _check_null(what, effect, model, data, key, plain)
        _check_away(what, effect, model, data, key, plain)
        _check_derivative(what, effect, model, data, key, plain)


def _run(model: Model, data: Mapping[str, Any], key: jax.Array) -> Trace:
    return handlers.trace(handlers.seed(model, key)).get_trace(**data)


def _rewritten(
    effect: Effect, parameters: Mapping[str, Any], model: Model, data: Mapping[str, Any], key: jax.Array
) -> Trace:
    """The model's run with the effect at given parameters; sites of the base model draw as without it."""

    def extended() -> Any:
        with Rewriting(None, [effect], {effect.name: parameters}, data):
            return model(**data)

    plain = {n: m["value"] for n, m in _run(model, data, key).items() if m["type"] == "sample"}
    fixed = handlers.substitute(handlers.seed(extended, key), data=plain)
    return handlers.trace(fixed).get_trace()


def _check_parameter(what: str, parameter: Parameter, key: jax.Array) -> None:
    expect(parameter.unit, what, "a unit", "none", "Give the SI unit, '1' for a pure number")
    draws = np.asarray(parameter.prior.sample(key, (_DRAWS,)))
    expect(np.all(np.isfinite(draws)), what, "finite prior draws", "others", "Give a proper prior")
    log_prob = np.asarray(parameter.prior.log_prob(draws))
    expect(np.all(np.isfinite(log_prob)), what, "a finite prior density", "another", "Give a proper prior")
    below, above = np.any(draws < parameter.null), np.any(draws > parameter.null)
    inside = below and above
    edge = parameter.is_one_sided and above
    got = f"draws from {draws.min():.3g} to {draws.max():.3g}"
    remedy = "Let the prior's support contain the null, or begin at it"
    expect(inside or edge, what, f"a prior around the null {parameter.null:g}, or above it", got, remedy)


def _check_null(  # noqa: PLR0917
    what: str, effect: Effect, model: Model, data: Mapping[str, Any], key: jax.Array, plain: Trace
) -> None:
    at_null = _rewritten(effect, effect.null(), model, data, key)
    remedy = "Make the rewrite the identity at the null, without rounding"
    for name, message in plain.items():
        if message["type"] not in ("sample", "deterministic"):
            continue
        before, after = np.asarray(message["value"]), np.asarray(at_null[name]["value"])
        unchanged = may_become(before.shape, after.shape) and same(
            np.broadcast_to(before, after.shape), after
        )
        expect(unchanged, what, f"{name!r} unchanged at the null", "another value", remedy)
        if message["type"] == "sample" and name in effect.distributions:
            before, after = (np.asarray(m["fn"].log_prob(m["value"])) for m in (message, at_null[name]))
            expect(
                same(before, after), what, f"the density of {name!r} unchanged at the null", "another", remedy
            )


def _check_away(  # noqa: PLR0917
    what: str, effect: Effect, model: Model, data: Mapping[str, Any], key: jax.Array, plain: Trace
) -> None:
    keys = jax.random.split(key, len(effect.parameters))
    parameters = {p.name: p.prior.sample(k) for p, k in zip(effect.parameters, keys, strict=True)}
    moved = _rewritten(effect, parameters, model, data, key)
    for name in effect.rewrites:
        before, after = np.asarray(plain[name]["value"]), np.asarray(moved[name]["value"])
        kept = before.dtype == after.dtype and before.ndim == after.ndim
        expected, got = f"{before.dtype} of rank {before.ndim}", f"{after.dtype} of rank {after.ndim}"
        expect(kept, f"{what}, site {name!r}", expected, got, "Return the site's type and rank")
        finite = np.all(np.isfinite(after))
        expect(finite, f"{what}, site {name!r}", "finite values", "others", "Keep the rewrite finite")
    for name in effect.distributions:
        density = np.asarray(moved[name]["fn"].log_prob(moved[name]["value"]))
        finite = np.all(np.isfinite(density))
        expect(finite, f"{what}, site {name!r}", "a finite density", "another", "Keep the rewrite finite")


def _check_derivative(  # noqa: PLR0917
    what: str, effect: Effect, model: Model, data: Mapping[str, Any], key: jax.Array, plain: Trace
) -> None:
    null = {name: jnp.asarray(value, dtype=float) for name, value in effect.null().items()}
    fixed = _field(effect, data, plain)
    sizes = {name: _size(plain[name]["value"]) for name in effect.rewrites}
    for index, parameter in enumerate(effect.parameters):
        name = parameter.name
        random = jax.random.normal(jax.random.fold_in(key, index), null[name].shape)
        direction = _spread(parameter) * jnp.abs(random)

        def outputs(step: jax.Array, name: str = name, along: jax.Array = direction) -> jax.Array:
            moved = {**null, **fixed, name: null[name] + step * along}
            return _outputs(_rewritten(effect, moved, model, data, key), effect, sizes)

        _compare(f"{what}, parameter {name!r}", outputs, one_sided=parameter.is_one_sided)


def _compare(what: str, outputs: Callable[[jax.Array], jax.Array], *, one_sided: bool) -> None:
    zero = jnp.zeros(())
    _, slope = jax.jvp(outputs, (zero,), (jnp.ones(()),))
    finite = bool(jnp.all(jnp.isfinite(slope)))
    remedy = "Keep the rewrite smooth at the null; see where a root, an absolute value or a comparison acts"
    expect(finite, what, "a finite derivative at the null", "another", remedy)
    step = jnp.asarray(float(jnp.finfo(zero.dtype).eps) ** (1 / 3))
    if one_sided:
        numeric = (-3 * outputs(zero) + 4 * outputs(step) - outputs(2 * step)) / (2 * step)
    else:
        numeric = (outputs(step) - outputs(-step)) / (2 * step)
    size = float(jnp.max(jnp.abs(numeric), initial=0.0)) + float(jnp.max(jnp.abs(slope), initial=0.0))
    rounding = 20 * float(jnp.finfo(zero.dtype).eps) * float(jnp.max(jnp.abs(outputs(zero)))) / float(step)
    worst = float(jnp.max(jnp.abs(numeric - slope), initial=0.0))
    got = f"a difference of {worst:.3g} in {size:.3g}"
    expect(worst <= 1e-3 * size + rounding, what, "the derivative of finite differences", got, remedy)


def _spread(parameter: Parameter) -> jax.Array:
    draws = parameter.prior.sample(jax.random.key(0), (_DRAWS,))
    return jnp.std(jnp.asarray(draws), axis=0)


def _field(effect: Effect, data: Mapping[str, Any], plain: Trace) -> dict[str, jax.Array]:
    """A fixed field for a variance effect, nothing for others."""
    if effect.kind == "mean":
        return {}
    context = {**data, **{name: message["value"] for name, message in plain.items() if "value" in message}}
    shape = effect.shape_of_field(plain[effect.sites[0]]["value"], context)
    return {FIELD: jax.random.normal(jax.random.key(1), shape)}


def _size(value: Any) -> jax.Array:
    """The largest modulus, one where all is zero."""
    largest = jnp.max(jnp.abs(jnp.asarray(value)), initial=0.0)
    return jnp.where(largest > 0, largest, 1.0)


def _outputs(trace: Trace, effect: Effect, sizes: Mapping[str, jax.Array]) -> jax.Array:
    """All that the effect rewrites, as one real vector, each site in units of its size at the null."""
    parts: list[jax.Array] = []
    for name in effect.rewrites:
        value = jnp.asarray(trace[name]["value"]).ravel() / sizes[name]
        parts += [value.real, value.imag] if jnp.iscomplexobj(value) else [value]
    for name in effect.distributions:
        parts.append(jnp.ravel(trace[name]["fn"].log_prob(trace[name]["value"])))
    return jnp.concatenate(parts)
