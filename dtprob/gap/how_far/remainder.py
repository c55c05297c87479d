"""The unexplained rest of a gap, modelled at its site, so that predictions stay calibrated while its cause is unknown.

The site families with the most evidence get random weights: normal, of a common standard deviation for each family, which
is found by maximal evidence in a full refit. What is shared by all clusters carries over to new ones; what is each
cluster's own, or a spread, widens the prediction there. Both are judged on clusters that were left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.how_far import closed
from dtprob.gap.how_far.calibration import Calibration, calibration
from dtprob.gap.how_far.closed import ClosedFraction, Fold, HeldOut
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation import whiten
from dtprob.gap.view import View
from dtprob.gap.where.curves import Curves
from dtprob.gap.where.suspects import Suspect

_TRIED, _TAKEN = 6, 3
"""Families that are tried, and modelled together, at most."""
_WEIGHTS: Final = 96
"""Weights shared by all clusters that a family may have."""
_LEAST: Final = 3.0
"""Nats of evidence that a family must bring."""
_SAME: Final = 0.99
"""Families of one pattern and nearly the same evidence are one thing under two names."""
_NAME: Final = "remainder"
_UNIT: Final = "scale"


@dataclass(frozen=True)
class Term:
    """One family of the model of the remainder.

    Attributes:
        site: where it acts.
        shape: what is added and how it varies, in words.
        weights: how many random weights it has.
        per_cluster: whether each cluster has weights of its own, which say nothing of new ones beyond their spread.
        evidence: nats that it brings to first order, alone.
    """

    site: str
    shape: str
    weights: int
    per_cluster: bool
    evidence: float


@dataclass(frozen=True)
class Remainder:
    """How a model of the remainder fares on clusters that were left out.

    Attributes:
        terms: of the model, the one with the most evidence first.
        closed: share of what the causes leave that it closes; below zero if it makes predictions worse.
        held: held-out results with it.
        before, after: calibration of the predictions without and with it.
    """

    terms: tuple[Term, ...]
    closed: ClosedFraction
    held: HeldOut
    before: Calibration
    after: Calibration


def model_remainder(
    view: View, folds: Sequence[Fold], held: HeldOut, best: float, key: jax.Array
) -> Remainder | None:
    """Model what a fit leaves, and judge the model on held-out clusters; None where nothing can be modelled.

    Args:
        view: the fit with the accepted effects, and the families that are suspected there.
        folds: which clusters are left out in turn, and the fits to the others.
        held: held-out results of these.
        best: the optimistic floor of the causes, total log likelihood.
        key: for the bootstrap over clusters.
    """
    problem = view.problem
    named = _named(shortlist(problem, view.location.suspects))
    if not named:
        return None
    wider, fitted = _wider(view, named)
    full = _forward(wider, fitted, tuple(named))
    taken = [n for n in named if n in full.effects]
    if not taken:
        return None
    parts = list(closed.fold_fits(wider, full, np.sum([i * h for i, (h, _) in enumerate(folds)], axis=0)))
    after = closed.judged(wider, parts)
    reached = max(float(after.log_likelihood.sum()), float(held.log_likelihood.sum()))
    size = sum(_determined(wider, full, n) for n in taken)
    cost = closed.cost(size, len(parts))
    floor = closed.Floor(reached, max(best - cost, reached), size, cost)
    return Remainder(
        tuple(_term(problem, named[n]) for n in taken),
        closed.share(held, after, floor, key),
        after,
        calibration(problem, folds),
        calibration(wider, parts),
    )


def alone(view: View) -> float:
    """Log evidence of the fit with the one family of a site that has the most, less the price of having picked it.

    Minus infinity where none is suspected. Families of which each cluster has its own weights are left out: they follow
    anything.
    """
    problem = view.problem
    shared = [s for s in view.location.suspects if not _is_per_cluster(problem, s)]
    apart = {(s.site, round(s.evidence, 3)): s for s in shared if _size(problem, s) <= _WEIGHTS}
    named = _named(list(apart.values())[:_TRIED])
    if not named:
        return -np.inf
    wider, fitted = _wider(view, named)
    return max(_fitted_with(wider, fitted, name).log_evidence - s.price for name, s in named.items())


def _named(suspects: Sequence[Suspect]) -> dict[str, Suspect]:
    """Families by the names that they have as effects."""
    return {f"{_NAME}[{i}]": suspect for i, suspect in enumerate(suspects)}


def _wider(view: View, named: Mapping[str, Suspect]) -> tuple[Problem, fitting.Fit]:
    """The problem with families as fields, and the view's fit in its coordinates."""
    problem, fitted = view.problem, view.fitted
    at = problem.compiled.sites(fitted.x)
    positive = {s.site for s in named.values() if s.rows is None and _is_positive(at[s.site])}
    fields = [field_of(problem, n, s, positive=s.site in positive) for n, s in named.items()]
    own = [n for n, s in named.items() if _is_by_cluster(problem, s)]
    wider = problem.with_fields(fields, own)
    return wider, replace(fitted, x=wider.translate(fitted.x, problem))


def shortlist(problem: Problem, suspects: Sequence[Suspect]) -> tuple[Suspect, ...]:
    """The families to try: most evidence first, each thing once."""
    chosen: list[Suspect] = []
    for suspect in sorted(suspects, key=lambda s: (-round(s.evidence, 3), s.rows is not None)):
        size = 0 if _is_per_cluster(problem, suspect) else _size(problem, suspect)
        label = suspect.family.pattern.label
        known = [s for s in chosen if s.family.pattern.label == label]
        same = any(s.site == suspect.site or suspect.evidence > _SAME * s.evidence for s in known)
        if suspect.evidence >= _LEAST and not same and size <= _WEIGHTS:
            chosen.append(suspect)
    return tuple(chosen[:_TRIED])


def _forward(problem: Problem, fitted: fitting.Fit, names: Sequence[str]) -> fitting.Fit:
    """The fit with those of the fields that raise the evidence, each beside the ones before it."""
    taken = 0
    for name in names:
        trial = _fitted_with(problem, fitted, name)
        if trial.log_evidence > fitted.log_evidence + _LEAST:
            fitted, taken = trial, taken + 1
        if taken == _TAKEN:
            break
    return fitted


def _fitted_with(problem: Problem, fitted: fitting.Fit, name: str) -> fitting.Fit:
    """The fit with one more field."""
    spread = {**fitted.spread, name: 1.0}
    return fitting.fit(problem, fitted.x, (*fitted.effects, name), spread=spread)


def _term(problem: Problem, suspect: Suspect) -> Term:
    return Term(
        suspect.site,
        suspect.family.label,
        _size(problem, suspect),
        _is_per_cluster(problem, suspect),
        suspect.evidence,
    )


def _determined(problem: Problem, fitted: fitting.Fit, name: str) -> float:
    """Number of shared weights that the data determine."""
    place = {int(i): j for j, i in enumerate(fitted.global_index)}
    index = [place[int(i)] for b in problem.blocks_of(name) if not b.local for i in b.index[0]]
    return float(np.sum(1 - np.diag(fitted.covariance)[index] / fitted.spread[name] ** 2))


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
    return (count, each) if _is_by_cluster(problem, suspect) else (*(1 for _ in shape), count, each)


def _size(problem: Problem, suspect: Suspect) -> int:
    return int(np.prod(_field_shape(problem, suspect), dtype=int))


def _is_by_cluster(problem: Problem, suspect: Suspect) -> bool:
    """Whether there is a curve for each cluster that a column of the data names."""
    curves = suspect.family.pattern.curves
    return (
        curves is not None and curves.column == problem.cluster_name and curves.extent[0] == problem.n_cluster
    )


def _is_per_cluster(problem: Problem, suspect: Suspect) -> bool:
    axes, pattern = problem.declaration.sites[suspect.site].axes, suspect.family.pattern
    kept = [axes[i] for i in pattern.kept if i < len(axes)]
    return _is_by_cluster(problem, suspect) or (
        pattern.curves is None and problem.declaration.cluster in kept
    )


def _is_positive(value: jax.Array) -> bool:
    return not jnp.iscomplexobj(value) and bool(jnp.all(value > 0))


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
        distributions[suspect.site] = lambda fn, p, _: _redistributed(fn, suspect, step(p[_UNIT] * p[FIELD]))
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


def _redistributed(fn: Any, suspect: Suspect, step: jax.Array) -> Any:
    """An observed distribution with moved location (in standard deviations) or spread (in whitened units)."""
    observed = whiten.observation(fn, jnp.zeros(fn.batch_shape + fn.event_shape), suspect.site)
    found = whiten.moved(observed, step, spread=suspect.family.kind == "spread")
    if found is None:
        return fn
    new = whiten.distribution(found)
    if "mask" not in found.parameters:
        return new
    mask = found.parameters["mask"] > 0
    return new.mask(mask[..., 0] if new.event_shape else mask)
