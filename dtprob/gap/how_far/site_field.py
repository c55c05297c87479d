"""A family of a site as a random effect: normal weights of what is added to the site, or to what is observed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation import whiten
from dtprob.gap.where.curves import Curves
from dtprob.gap.where.suspects import Suspect

_UNIT: Final = "scale"


def _shape(problem: Problem, suspect: Suspect) -> tuple[int, ...]:
    """Shape of the site."""
    if suspect.rows is not None:
        return problem.declaration.observed[suspect.site].shape
    return tuple(problem.float_sites[suspect.site].shape)


def _parts(suspect: Suspect, problem: Problem) -> int:
    """Two for a complex site."""
    if suspect.rows is not None:
        return len(suspect.rows)
    return 2 if jnp.issubdtype(problem.float_sites[suspect.site].dtype, jnp.complexfloating) else 1


def _field_shape(problem: Problem, suspect: Suspect) -> tuple[int, ...]:
    """Shape of the random weights: axes of the site, one of the curves, one of what each curve has weights for."""
    shape, parts, pattern = _shape(problem, suspect), _parts(suspect, problem), suspect.family.pattern
    if pattern.curves is None:
        return (*(n if i in pattern.kept else 1 for i, n in enumerate(shape)), parts)
    count, size = pattern.curves.extent
    each = int(np.prod([shape[i] for i in pattern.kept])) // size * parts
    return (count, each) if is_by_cluster(problem, suspect) else (*(1 for _ in shape), count, each)


def size_of(problem: Problem, suspect: Suspect) -> int:
    """How many random weights a family has."""
    return int(np.prod(_field_shape(problem, suspect), dtype=int))


def is_by_cluster(problem: Problem, suspect: Suspect) -> bool:
    """Whether there is a curve for each cluster that a column of the data names."""
    curves = suspect.family.pattern.curves
    return (
        curves is not None and curves.column == problem.cluster_name and curves.extent[0] == problem.n_cluster
    )


def is_per_cluster(problem: Problem, suspect: Suspect) -> bool:
    """Whether each cluster has weights of its own."""
    axes, pattern = problem.declaration.sites[suspect.site].axes, suspect.family.pattern
    kept = [axes[i] for i in pattern.kept if i < len(axes)]
    return is_by_cluster(problem, suspect) or (pattern.curves is None and problem.declaration.cluster in kept)


def field_of(problem: Problem, name: str, suspect: Suspect, *, positive: bool) -> Effect:
    """The family as a random field whose standard deviation is 1 where its evidence to first order is largest.

    Args:
        problem: with the site.
        name: of the effect.
        suspect: the family.
        positive: whether the site's values have to stay positive.
    """
    shape, parts, field_shape = (
        _shape(problem, suspect),
        _parts(suspect, problem),
        _field_shape(problem, suspect),
    )
    step = _step(suspect, shape, parts)
    rewrites: dict[str, Any] = {}
    distributions: dict[str, Any] = {}
    if suspect.rows is None:
        rewrites[suspect.site] = lambda value, p, _: _moved(
            value, step(p[_UNIT] * p[FIELD]), positive=positive
        )
    else:
        seen = problem.observed.values[suspect.site]
        distributions[suspect.site] = lambda fn, p, _: _redistributed(
            fn, suspect, step(p[_UNIT] * p[FIELD]), seen
        )
    family, _, instance = name.rstrip("]").partition("[")
    return Effect(
        family,
        rewrites,
        (Parameter(_UNIT, dist.HalfNormal(1.0)),),
        instance=instance,
        kind="variance",
        distributions=distributions,
        field_shape=lambda *_: field_shape,
    )


def _step(suspect: Suspect, shape: tuple[int, ...], parts: int) -> Callable[[Any], jax.Array]:
    """Random weights -> what is added to the site."""
    pattern, factor, spread = suspect.family.pattern, jnp.asarray(suspect.family.factor), suspect.spread
    kept = tuple(n if i in pattern.kept else 1 for i, n in enumerate(shape))
    curves = pattern.curves

    def step(weights: Any) -> jax.Array:
        pair = spread * (weights if curves is None else weights.reshape(curves.extent[0], -1))
        along = pair if curves is None else _along(curves, pair)
        along = along.reshape(*kept, parts)
        return factor * (along[..., 0] if parts == 1 else along[..., 0] + 1j * along[..., 1])

    return step


def _along(curves: Curves, weights: jax.Array) -> jax.Array:
    """What weights (weight, rest) of curves add up to, (position, rest)."""
    if isinstance(curves.values, np.ndarray):
        return jnp.asarray(curves.values).T @ weights
    # of very many weights each position has a few
    entries, (_, positions) = curves.values.tocoo(), curves.extent
    added = entries.data[:, None] * weights[entries.row]
    return jnp.zeros((positions, weights.shape[1])).at[entries.col].add(added)


def _moved(value: jax.Array, step: jax.Array, *, positive: bool) -> jax.Array:
    """A site's value after a step; what is positive stays so."""
    return value * jnp.exp(step / value) if positive else value + step


def _redistributed(fn: Any, suspect: Suspect, step: jax.Array, seen: jax.Array) -> Any:
    """An observed distribution with moved location (in standard deviations) or spread (in whitened units).

    What was seen tells the limits of censored readings; other data, of another shape, are taken to have none.
    """
    shape = fn.batch_shape + fn.event_shape
    value = seen if seen.shape == shape else jnp.full(shape, jnp.nan)
    observed = whiten.observation(fn, value, suspect.site)
    found = whiten.moved(observed, step, spread=suspect.family.kind == "spread", about=True)
    if found is None:
        return fn
    new = whiten.distribution(found)
    if "mask" not in found.parameters:
        return new
    mask = found.parameters["mask"] > 0
    return new.mask(mask[..., 0] if new.event_shape else mask)
