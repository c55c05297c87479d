"""Effects that may act anywhere: where the scores of one are largest, and whether larger than chance lets them be.

The score of an effect of one size is told at every place that it names (`Parameter.tried`), or at quantiles of its prior
(see `dtprob.gap.which.offered`), from the site gradients that the maps use too. The effect is then screened and fitted from
its best place; that it was the best of many is paid for by the same maximum in every replicate.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import jax
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Float
from scipy import stats

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting.bootstrap import Replicates
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.plausible import is_one_sided, limits, nulls, places
from dtprob.gap.model.problem import Problem
from dtprob.gap.tails import LOG_SMALLEST, any_of, effective_tests, family_wise, gamma_tail
from dtprob.gap.which.directions import surroundings
from dtprob.gap.which.offered import Values, may_be_anywhere, offered

_MOST_PRODUCTS: Final = 5e10
"""Products of scores that are worth looking for the places of effects; beyond, places are left out."""
_FINER: Final = {"mean": (512, 32), "variance": (16, 4)}
"""Places around which three times finer ones are looked at, and of these again. Those of random fields, whose phases are
free, change slowly from one to the next."""
_AT_ONCE: Final = 1 << 17
"""Scores that are looked at together, so that they stay in the processor's cache."""
_PORTION: Final = 576
"""Places whose scores are told in one run, at most."""


class _Grid(NamedTuple):
    """Places as flat parameters, how far apart neighbours are, and between what finer looks stay where priors end."""

    points: Float[np.ndarray, "place parameter"]
    spacing: Float[np.ndarray, "place parameter"]
    low: Float[np.ndarray, " parameter"]
    high: Float[np.ndarray, " parameter"]


@dataclass(frozen=True)
class Placed:
    """The best place of an effect.

    Attributes:
        p_value: of its score there, that it is the best of many places accounted for.
        replicate_p: the same of each replicate at its own best place.
        price: log of the effective number of places.
        information: J of the size of a mean effect at a typical place, the median of those that are tried.
    """

    p_value: float
    replicate_p: Float[np.ndarray, " replicate"]
    price: float
    information: float


def place(problem: Problem, fitted: Fit, drawn: Replicates) -> tuple[Problem, Mapping[str, Placed]]:
    """The problem with each effect that may act anywhere at its best place, and how that was found.

    Args:
        problem: the model and candidates on their data.
        fitted: the effects that it has stay where they are.
        drawn: site gradients of the data and of replicates at the fit.
    """
    left = [e for e in problem.effects if e.name not in fitted.effects and may_be_anywhere(e)]
    left = [e for e in left if not drawn.gradients.keys().isdisjoint(e.rewrites)]
    if not left:
        return problem, {}
    around = surroundings(problem, fitted.x).grown()
    tried = offered(problem, left, around, drawn)
    found, moved = {}, {}
    for effect in (e for e in left if e.name in tried):
        entries = sum(drawn.gradients[site].size for site in effect.rewrites if site in drawn.gradients)
        grid = _grid(effect, tried[effect.name], int(_MOST_PRODUCTS / (entries * len(tried))))
        found[effect.name], best = _best(problem, effect, around, drawn, grid)
        moved[effect.name] = _at(effect, best)
    if not found:
        return problem, {}
    return problem.with_candidates([moved.get(e.name, e) for e in problem.effects]), found


def _best(
    problem: Problem,
    effect: Effect,
    around: Mapping[str, jax.Array],
    drawn: Replicates,
    grid: _Grid,
) -> tuple[Placed, np.ndarray]:
    """How the best place of an effect was found, and its flat parameters there."""
    is_field, ways = effect.kind == "variance", _ways(grid)
    one_sided = is_field or is_one_sided(effect)
    portion = min(_PORTION, len(ways) * len(grid.points))  # all looks are compiled once

    def scores_at(points: np.ndarray) -> np.ndarray:
        """Scores (place, n)."""
        count = -(-len(points) // portion) * portion
        padded = points[np.arange(count) % len(points)].reshape(-1, portion, points.shape[1])
        scores = [
            problem.programs.place_scores(effect.name, around, drawn.gradients, part) for part in padded
        ]
        return np.concatenate(scores)[: len(points)]

    def told(scores: np.ndarray) -> np.ndarray:
        """How many standard deviations (place, n) they are from 0."""
        t = _quantiles(scores) if is_field else _standardised(scores)
        return t if one_sided else np.abs(t)

    scores = scores_at(grid.points)
    t = told(scores)
    best, looks = _finer(grid, t, ways, lambda points: told(scores_at(points)), _FINER[effect.kind])
    freedom = looks.shape[1] - 2
    p = _tail(looks[-1, :1], freedom, one_sided=one_sided)
    replicate_p = _tail(looks[:2, 1:], freedom, one_sided=one_sided)
    several = _several(replicate_p, len(ways), everywhere=len(grid.points) <= _FINER[effect.kind][0])
    information = float(np.median(np.mean(scores[:, 1:] ** 2, axis=1)))
    chance = float(any_of(p, several)[0])
    return Placed(
        chance, family_wise(replicate_p[-1], replicate_p[-1]), float(np.log(several)), information
    ), best


def _several(replicate_p: Float[np.ndarray, "look replicate"], ways: int, *, everywhere: bool) -> float:
    """Effective number of places that the data were looked for at.

    What is looked at more finely in the data alone could have been in as many more places. Where the first finer look was
    around all places, and so at those of the replicates too, they tell how many these are; the second adds no more.
    """
    coarse, fine = (effective_tests(p) for p in replicate_p)
    return min(fine**2 / coarse, coarse * ways) if everywhere else coarse * ways


def _ways(grid: _Grid) -> np.ndarray:
    """Steps (way, parameter) from a place to its neighbours along all parameters that have several, and to itself."""
    ways = np.array(list(itertools.product((-1, 0, 1), repeat=grid.points.shape[1])))
    return ways[~ways[:, (grid.spacing == 0).all(axis=0)].any(axis=1)]


def _finer(
    grid: _Grid,
    scores: Float[np.ndarray, "place n"],
    ways: np.ndarray,
    told: Callable[[np.ndarray], np.ndarray],
    counts: Sequence[int],
) -> tuple[np.ndarray, Float[np.ndarray, "look n"]]:
    """The best place of the data, after finer and finer looks around those with their largest scores of the grid.

    Besides the largest scores up to each look, of the data and of the replicates at the same places.
    """
    points, spacing = grid.points, grid.spacing
    best, looks = points[int(scores[:, 0].argmax())], [scores.max(axis=0)]
    for kept in counts:
        chosen = np.argsort(-scores[:, 0])[:kept]
        spacing = spacing[chosen] / 3
        points = (points[chosen][:, None] + ways * spacing[:, None]).reshape(-1, points.shape[1])
        points = np.clip(points, grid.low, grid.high)
        spacing, scores = np.repeat(spacing, len(ways), axis=0), told(points)
        if scores[:, 0].max() > looks[-1][0]:
            best = points[int(scores[:, 0].argmax())]
        looks.append(np.maximum(looks[-1], scores.max(axis=0)))
    return best, np.stack(looks)


def _grid(effect: Effect, tried: Values, most: int) -> _Grid:
    """Combinations (place, parameter) of the places that are tried, the size at its null, and how far apart they are."""
    values = [v for v, p in zip(tried, effect.parameters, strict=True) for _ in range(p.size)]
    gaps = [np.gradient(v) if len(v) > 1 else np.zeros(1) for v in values]
    points, spacing = (
        np.stack(np.meshgrid(*v, indexing="ij"), -1).reshape(-1, len(v)) for v in (values, gaps)
    )
    kept = np.linspace(0, len(points) - 1, min(max(most, 1), len(points))).round().astype(int)
    low, high = limits(effect)
    low = np.where(np.isfinite(low), points.min(axis=0), -np.inf)
    high = np.where(np.isfinite(high), points.max(axis=0), np.inf)
    return _Grid(points[kept], spacing[kept], low, high)


@np.errstate(invalid="ignore")  # a place where the model is not finite tells nothing
def _standardised(scores: Float[np.ndarray, "place n"]) -> Float[np.ndarray, "place n"]:
    """Scores over their standard deviation in the replicates, of which the score itself is none; 0 without a score."""
    found, count = np.zeros_like(scores), scores.shape[1] - 1
    total = np.einsum("pn,pn->p", scores[:, 1:], scores[:, 1:])
    least = 1e-12 * max(float(np.max(total / count, where=np.isfinite(total), initial=0.0)), 1e-300)
    width = max(_AT_ONCE // scores.shape[1], 1)
    for start in range(0, len(scores), width):
        part = slice(start, start + width)
        own, whole = scores[part], total[part, None]
        variance = (whole - own**2) / (count - 1)
        variance[:, :1] = whole / count
        told = (variance > least) & np.isfinite(own).all(axis=1, keepdims=True)
        np.divide(own, np.sqrt(variance, where=told, out=variance), where=told, out=found[part])
    return found


def _quantiles(energies: Float[np.ndarray, "place n"]) -> Float[np.ndarray, "place n"]:
    """Normal quantiles of the energies of a random field, each beside the replicates but itself."""
    null, count = energies[:, 1:], energies.shape[1] - 1
    total, square = null.sum(axis=1, keepdims=True), (null**2).sum(axis=1, keepdims=True)
    n = np.array([count, *[count - 1] * count])
    own = np.concatenate([np.zeros_like(total), null], axis=1)
    mean = (total - own) / n
    return gamma_tail(energies, mean, (square - own**2) / n - mean**2)[1]


def _tail(t: Float[np.ndarray, " n"], freedom: int, *, one_sided: bool) -> Float[np.ndarray, " n"]:
    """p-value of the largest of scores over their standard deviation, as if it had been the only one."""
    return np.maximum(stats.t.sf(t, freedom) * (1 if one_sided else 2), np.exp(LOG_SMALLEST))


def _at(effect: Effect, point: Float[np.ndarray, " parameter"]) -> Effect:
    """The effect with its places here."""
    moved = np.split(
        np.where(places(effect), point, nulls(effect)), np.cumsum([p.size for p in effect.parameters])
    )
    parameters = (_moved(p, entries) for p, entries in zip(effect.parameters, moved, strict=False))
    return replace(effect, parameters=tuple(parameters))


def _moved(parameter: Parameter, entries: Float[np.ndarray, " entry"]) -> Parameter:
    """The parameter at its best place: about that it is where places are named, else its prior stands."""
    if not parameter.is_place or parameter.shape:
        return parameter
    to = float(entries[0])
    prior = dist.Normal(to, float(parameter.scale)) if parameter.tried else parameter.prior
    return replace(parameter, prior=prior, null=to)
