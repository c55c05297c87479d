"""Distributions of which only a density and draws are known, as a user's own class: rows by differentiation and quadrature.

Scores are derivatives of the log density along each parameter, and their covariance is a sum over places that a few draws
tell the range of.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from numpyro.distributions import biject_to, constraints

from dtprob.gap.observation.likelihood import Likelihood, Move
from dtprob.gap.observation.mixed import Mixed
from dtprob.gap.observation.residuals import Parameters
from dtprob.gap.observation.whitening import Scores, outer, whitened

_DRAWS: Final = 64
_QUANTILES: Final = (0.16, 0.5, 0.84)
"""Of the draws: a standard deviation of a normal distribution below its middle, the middle, and one above."""
_NODES: Final = 81
_FARTHEST: Final = 5.0
"""Places lie at sinh of even numbers up to this: 74 standard deviations out."""
_LEAST: Final = 1e-12
_SPREADS: Final = 20.0
"""Standard deviations that places of whole numbers span, each way."""

_MET: Final[dict[str, tuple[type, Likelihood]]] = {}
"""By their name: classes that a model has used, each with what is known of it."""


def met(family: str) -> tuple[type, Likelihood] | None:
    """The class of such a family, and what is known of it; None where no model has used it."""
    return _MET.get(family)


def parameters_of(fn: Any) -> dict[str, Any] | None:
    """The parameters of a distribution that can be taken in this way; None where it cannot.

    It needs `arg_constraints` of numbers, an `__init__` that takes them by name, `log_prob`, `sample`, single numbers as
    its values, and a support that does not depend on its parameters.
    """
    kind, declared = type(fn), getattr(fn, "arg_constraints", {})
    dependent = constraints.is_dependent(kind.support) or constraints.is_dependent(fn.support)
    if not declared or fn.event_shape or dependent or any(c.event_dim for c in declared.values()):
        return None
    try:
        given = {name: jnp.asarray(getattr(fn, name), float) for name in declared}
        jax.eval_shape(lambda p: kind(**p).sample(jax.random.key(0)), given)
        jax.eval_shape(lambda p: kind(**p).log_prob(fn.support.feasible_like(jnp.zeros(()))), given)
    except (TypeError, AttributeError, NotImplementedError):
        return None
    return given


def family_of(kind: type) -> str:
    """The name under which a class is known from now on."""
    family = f"{kind.__module__}.{kind.__qualname__}"
    if family not in _MET or _MET[family][0] is not kind:
        _MET[family] = kind, _likelihood(kind)
    return family


def _likelihood(kind: Any) -> Likelihood:
    declared: Mapping[str, Any] = kind.arg_constraints
    free = [name for name, constraint in declared.items() if not constraint.is_discrete]

    def make(**p: Any) -> dist.Distribution:
        return kind(**{name: p[name] for name in declared})

    def scores(p: Parameters, value: Any) -> jax.Array:
        slope = jax.grad(lambda q: jnp.sum(make(**{**p, **q}).log_prob(value)))({n: p[n] for n in free})
        return jnp.stack([slope[name] for name in free])

    def information(p: Parameters) -> jax.Array:
        p = jax.lax.stop_gradient(p)

        def one(value: jax.Array) -> jax.Array:
            score = scores(p, value)
            return outer(score, score)

        return _expected(make(**p), one)

    def mean(p: Parameters) -> jax.Array:
        try:
            return jnp.asarray(make(**p).mean)
        except NotImplementedError:
            return _expected(make(**p), lambda value: jnp.asarray(value, float))

    known = Likelihood(make, tuple(declared), scores, scores, located=1, mean=mean)
    rows = Scores(scores, information, lambda _, change: jnp.stack([change[name] for name in free]))
    return whitened(known, rows, _along(free, declared))


def _expected(fn: Any, of: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """The expectation of a function of values (*value) -> (*value, ...)."""
    if not isinstance(fn, Mixed):
        return _over(fn, of)
    each = [(chance, _over(part, of)) for chance, part in fn.parts()]
    return jnp.stack([c.reshape(c.shape + (1,) * (m.ndim - c.ndim)) * m for c, m in each]).sum(axis=0)


def _over(fn: Any, of: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """The same place by place; memory is that of one."""
    support: Any = fn.support
    middle, width = _range(fn, support)
    place = _whole(middle, width, support) if support.is_discrete else _real(middle, width, support)

    def add(totals: Any, at: jax.Array) -> tuple[Any, None]:
        value, measure = place(at)
        weight = jnp.nan_to_num(jnp.exp(fn.log_prob(value)) * measure, posinf=0.0)
        found = of(value)
        further = weight.reshape(weight.shape + (1,) * (found.ndim - weight.ndim))
        told = jnp.where(further > 0, jnp.nan_to_num(found, posinf=0.0, neginf=0.0), 0.0)
        return (totals[0] + further * told, totals[1] + further), None

    along = jnp.linspace(-1.0, 1.0, _NODES)
    like = jax.eval_shape(lambda at: add((0.0, 0.0), at)[0], along[0])
    (total, whole), _ = jax.lax.scan(add, jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), like), along)
    return total / whole


def _range(fn: Any, support: Any) -> tuple[jax.Array, jax.Array]:
    """Middle and width of draws, in coordinates that have no bounds; whole numbers as they are."""
    keys = jax.random.split(jax.random.key(0), _DRAWS)
    values = jax.vmap(lambda key: jnp.asarray(fn.sample(key), float))(keys)
    if support.is_discrete:
        return jnp.median(values, axis=0), jnp.maximum(values.std(axis=0), 1.0)
    low, middle, high = jnp.quantile(biject_to(support).inv(values), jnp.asarray(_QUANTILES), axis=0)
    return middle, jnp.maximum((high - low) / 2, _LEAST * (1 + jnp.abs(middle)))


def _real(middle: jax.Array, width: jax.Array, support: Any) -> Callable[[Any], tuple[Any, Any]]:
    """Places, and what each stands for."""
    bijection: Any = biject_to(support)

    def place(at: jax.Array) -> tuple[jax.Array, jax.Array]:
        inner = middle + width * jnp.sinh(_FARTHEST * at)
        value, slope = jax.jvp(bijection, (inner,), (jnp.ones_like(inner),))
        return value, jnp.abs(slope) * width * jnp.cosh(_FARTHEST * at)

    return place


def _whole(middle: jax.Array, width: jax.Array, support: Any) -> Callable[[Any], tuple[Any, Any]]:
    """Whole numbers, all of them where few are likely."""
    half = _NODES // 2
    stride = jnp.ceil(jnp.maximum(_SPREADS * width / half, 1.0))

    def place(at: jax.Array) -> tuple[jax.Array, jax.Array]:
        value = jnp.floor(middle) + stride * jnp.round(at * half)
        can = jnp.asarray(support(value), bool)
        return jnp.where(can, value, support.feasible_like(value)), jnp.where(can, stride, 0.0)

    return place


def _along(free: Sequence[str], declared: Mapping[str, Any]) -> Move | None:
    """Moves of the first parameter by steps that are its own at first and never leave where it may be."""
    if not free:
        return None
    first = free[0]
    bijection: Any = biject_to(declared[first])

    def move(p: Parameters, step: jax.Array) -> Parameters:
        inner = bijection.inv(p[first])
        slope = jax.jvp(bijection, (inner,), (jnp.ones_like(inner),))[1]
        return {**p, first: bijection(inner + step / slope)}

    return move
