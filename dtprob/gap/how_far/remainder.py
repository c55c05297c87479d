"""The unexplained rest of a gap, modelled at its site, so that predictions stay calibrated while its cause is unknown.

The site families with the most evidence get random weights: normal, of a common standard deviation for each family, which
is found by maximal evidence in a full refit. What is shared by all clusters carries over to new ones; what is each
cluster's own, or a spread, widens the prediction there. Both are judged on clusters that were left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.determined import shared_weights
from dtprob.gap.how_far import closed
from dtprob.gap.how_far.calibration import Calibration, calibration
from dtprob.gap.how_far.closed import ClosedFraction, Fold, HeldOut
from dtprob.gap.how_far.site_field import field_of, is_by_cluster, is_per_cluster, size_of
from dtprob.gap.model.problem import Problem
from dtprob.gap.view import View
from dtprob.gap.where.suspects import Suspect

_TRIED, _TAKEN = 6, 3
"""Families that are tried, and modelled together, at most."""
_WEIGHTS: Final = 96
"""Weights shared by all clusters that a family may have."""
_LEAST: Final = 3.0
"""Nats of evidence that a family must bring."""
_SAME: Final = 0.99
"""Families of one pattern and nearly the same evidence are one thing under two names."""
_PROMISING: Final = 0.5
"""Share of a gain that a family's evidence to first order shows at least."""
_COARSE: Final = 0.03
"""Nats that a step of a fit has to gain where it is compared by whole nats with what effects gain."""
_NAME: Final = "remainder"


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
        beside: log evidence that the causes bring beside it; infinite where there are none.
    """

    terms: tuple[Term, ...]
    closed: ClosedFraction
    held: HeldOut
    before: Calibration
    after: Calibration
    beside: float


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
    fits = _forward(wider, fitted, tuple(named))
    if not fits:
        return None
    full, parts, after = _held(wider, fits, folds, held)
    taken = sorted((n for n in named if n in full.effects), key=lambda n: -named[n].evidence)
    reached = max(float(after.log_likelihood.sum()), float(held.log_likelihood.sum()))
    size = sum(shared_weights(wider, full, n) for n in taken)
    cost = closed.cost(size, len(parts))
    floor = closed.Floor(reached, max(best - cost, reached), size, cost)
    return Remainder(
        tuple(_term(problem, named[n]) for n in taken),
        closed.share(held, after, floor, key),
        after,
        calibration(problem, folds),
        calibration(wider, parts),
        full.log_evidence - _without(wider, full, fitted.effects) if fitted.effects else np.inf,
    )


def _held(
    wider: Problem, fits: Sequence[fitting.Fit], folds: Sequence[Fold], held: HeldOut
) -> tuple[fitting.Fit, list[Fold], HeldOut]:
    """The largest of nested fits that predicts held-out clusters better, else the smallest; with its folds and results."""
    assignment = np.sum([i * fold.held for i, fold in enumerate(folds)], axis=0)

    def judged(full: fitting.Fit) -> tuple[fitting.Fit, list[Fold], HeldOut]:
        refitted = closed.fold_fits(wider, full, assignment)
        # the causes are as hard to choose as they were, though here others of their families are no candidates
        parts = [part._replace(charged=fold.charged) for part, fold in zip(refitted, folds, strict=True)]
        return full, parts, closed.judged(wider, parts)

    least = held.log_likelihood.sum()
    better = (one for one in map(judged, reversed(fits[1:])) if one[2].log_likelihood.sum() > least)
    return next(better, None) or judged(fits[0])


def _without(wider: Problem, full: fitting.Fit, causes: Sequence[str]) -> float:
    """Log evidence of the model of the remainder alone, which may have to do more than beside the causes."""
    x, null, rest = full.x.copy(), wider.null(), tuple(n for n in full.effects if n not in causes)
    for block in (b for b in wider.layout.blocks if b.owner in causes):
        x[block.index] = null[block.index]
    spread = {n: max(full.spread[n], 1.0) for n in rest}
    return fitting.fit(wider, x, rest, spread=spread, tolerance=_COARSE).log_evidence


@dataclass(frozen=True)
class Alone:
    """The fit with one family of a site and no effect, in the problem in which the family is live.

    Attributes:
        name: of the family as an effect.
        problem: the model with the family as a field.
        fitted: the fit.
        weights: how many of the family's random weights the data determine.
    """

    name: str
    problem: Problem
    fitted: fitting.Fit
    weights: float


def alone(view: View, least: float, begun: Callable[[], None] = lambda: None) -> Iterator[Alone]:
    """Fits with one family of a site whose log evidence, less the price of having picked it, is more than the least.

    Families of which each cluster has its own weights are left out: they follow anything.

    Args:
        view: the fit without any effect, and the families that are suspected there.
        least: log evidence that matters; families that promise less than half of what that gains are not fitted.
        begun: called before fits.
    """
    problem, enough = view.problem, _PROMISING * (least - view.fitted.log_evidence)
    promising = [s for s in view.location.suspects if s.evidence - s.price > enough]
    shared = [s for s in promising if not is_per_cluster(problem, s)]
    apart = {(s.site, round(s.evidence, 3)): s for s in shared if size_of(problem, s) <= _WEIGHTS}
    named = _named(_tried(list(apart.values())))
    if not named:
        return
    begun()
    wider, fitted = _wider(view, named)
    for name, suspect in named.items():
        one = fitting.fit(wider, fitted.x, (name,), spread={name: 1.0}, tolerance=_COARSE)
        if one.log_evidence - suspect.price > least:
            yield Alone(name, wider, one, shared_weights(wider, one, name))


def beside(view: View, one: Alone) -> float:
    """Log evidence of a fit's effects with one family of a site beside them, from the fits of either alone."""
    family = [effect for effect in one.problem.effects if effect.name == one.name]
    wider = view.problem.with_fields(family, [*one.problem.per_cluster & {one.name}])
    effects, spread = (*view.fitted.effects, one.name), view.fitted.spread | one.fitted.spread
    starts = (wider.translate(at.fitted.x, at.problem) for at in (view, one))
    fits = (fitting.fit(wider, x, effects, spread=spread, tolerance=_COARSE) for x in starts)
    return max(fit.log_evidence for fit in fits)


def _site_by_site(suspects: Sequence[Suspect]) -> list[Suspect]:
    """The best family of each site first, then the second best: rows far out look like noise, whatever moves them."""
    met: Counter[str] = Counter()
    turns: list[int] = []
    for suspect in suspects:
        turns.append(met[suspect.site])
        met[suspect.site] += 1
    return [suspects[i] for i in sorted(range(len(suspects)), key=turns.__getitem__)]


def _named(suspects: Sequence[Suspect]) -> dict[str, Suspect]:
    """Families by the names that they have as effects."""
    return {f"{_NAME}[{i}]": suspect for i, suspect in enumerate(suspects)}


def _wider(view: View, named: Mapping[str, Suspect]) -> tuple[Problem, fitting.Fit]:
    """The problem with families as fields, and the view's fit in its coordinates."""
    problem, fitted = view.problem, view.fitted
    sites = {s.site for s in named.values() if s.rows is None}
    positive = {site for site in sites if _has_to_be_positive(problem, fitted.x, site)}
    fields = [field_of(problem, n, s, positive=s.site in positive) for n, s in named.items()]
    own = [n for n, s in named.items() if is_by_cluster(problem, s)]
    wider = problem.with_fields(fields, own)
    return wider, replace(fitted, x=wider.translate(fitted.x, problem))


def shortlist(problem: Problem, suspects: Sequence[Suspect]) -> tuple[Suspect, ...]:
    """The families to try: the steadiest evidence first, site by site, each thing once, and the one with most evidence.

    That one may be what each reading does by itself, which is what heavy tails look like.
    """
    chosen: list[Suspect] = []
    for suspect in sorted(suspects, key=lambda s: (-round(s.steady, 3), s.rows is not None)):
        size = 0 if is_per_cluster(problem, suspect) else size_of(problem, suspect)
        label = suspect.family.pattern.label
        known = [s for s in chosen if s.family.pattern.label == label]
        same = any(s.site == suspect.site or _are_alike(s, suspect) for s in known)
        if suspect.evidence >= _LEAST and not same and size <= _WEIGHTS:
            chosen.append(suspect)
    return _tried(chosen)


def _are_alike(one: Suspect, other: Suspect) -> bool:
    """Whether two families of one pattern have nearly the same evidence."""
    less, more = sorted((one.evidence, other.evidence))
    return less > _SAME * more


def _tried(suspects: Sequence[Suspect]) -> tuple[Suspect, ...]:
    """The first of them, site by site, and the one with the most evidence."""
    turns = _site_by_site(suspects)
    most = max(range(len(turns)), key=lambda i: turns[i].evidence, default=0)
    return tuple(turns[:_TRIED] if most < _TRIED else [*turns[: _TRIED - 1], turns[most]])


def _forward(problem: Problem, fitted: fitting.Fit, names: Sequence[str]) -> list[fitting.Fit]:
    """Fits with those of the fields that raise the evidence, each beside the ones before it, the best alone first."""
    alone = {name: _fitted_with(problem, fitted, name) for name in names}
    found: list[fitting.Fit] = []
    for name in sorted(names, key=lambda name: -alone[name].log_evidence):
        trial = _fitted_with(problem, fitted, name) if found else alone[name]
        if trial.log_evidence > fitted.log_evidence + _LEAST:
            fitted = trial
            found.append(fitted)
        if len(found) == _TAKEN:
            break
    return found


def _fitted_with(problem: Problem, fitted: fitting.Fit, name: str) -> fitting.Fit:
    """The fit with one more field."""
    spread = {**fitted.spread, name: 1.0}
    return fitting.fit(problem, fitted.x, (*fitted.effects, name), spread=spread)


def _term(problem: Problem, suspect: Suspect) -> Term:
    return Term(
        suspect.site,
        suspect.family.label,
        size_of(problem, suspect),
        is_per_cluster(problem, suspect),
        suspect.evidence,
    )


def _has_to_be_positive(problem: Problem, x: np.ndarray, site: str) -> bool:
    """Whether a site's values are positive and no density comes of negative ones, as of a scale or a rate."""
    like, found = problem.float_sites[site], problem.compiled.sites(x)[site]
    if jnp.issubdtype(like.dtype, jnp.complexfloating) or not bool(jnp.all(found > 0)):
        return False
    value = np.broadcast_to(np.asarray(found), like.shape)
    return not np.isfinite(problem.compiled.shifted(x, {site: -2 * value[None]}, 1)).all()
