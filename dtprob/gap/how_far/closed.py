"""How far: the share of the gap that the causes close, on clusters that the fit has not seen.

G = (L0 - L1) / (L0 - L*), with losses in nats on held-out clusters; the nuisances are refitted in L0, so that calibration
error is not credited to an effect. The interval is a paired bootstrap over clusters and over what the floor may be.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.marginal import marginal
from dtprob.gap.how_far.earlier import on_earlier_data
from dtprob.gap.model.misses import Miss
from dtprob.gap.model.problem import Problem


@dataclass(frozen=True)
class HeldOut:
    """Cross-fitted results of a set of effects.

    Attributes:
        log_likelihood: held-out log marginal likelihood of each cluster (cluster,), with its part of what the fits cost
            on earlier data.
        misses: by how much predictions miss each cluster, by observed site and measure.
        estimates: the effects' parameters in each fold, {site name: (fold, *shape flattened)}.
        doubt: variance of what the fits cost on earlier data, where nothing has changed since.
    """

    log_likelihood: np.ndarray
    misses: Mapping[str, Miss]
    estimates: dict[str, np.ndarray]
    doubt: float = 0.0


@dataclass(frozen=True)
class ClosedFraction:
    """Estimate and 90% interval; None where a gap is not established."""

    mean: float
    low: float
    high: float


def folds(n_cluster: int, n_folds: int) -> np.ndarray:
    """A fold number for each cluster: shuffled, but always the same way, so that a verdict does not hang on it."""
    order = np.random.default_rng(0).permutation(n_cluster)
    assignment = np.empty(n_cluster, int)
    assignment[order] = np.arange(n_cluster) % max(2, min(n_folds, n_cluster))
    return assignment


type Fold = tuple[np.ndarray, fitting.Fit]
"""Which clusters (cluster,) were left out, and the fit to the others."""


def cross_fit(problem: Problem, fitted: fitting.Fit, assignment: np.ndarray) -> HeldOut:
    """Refit without each fold in turn, and judge the fold."""
    return judged(problem, fold_fits(problem, fitted, assignment))


def fold_fits(problem: Problem, fitted: fitting.Fit, assignment: np.ndarray) -> Iterator[Fold]:
    """Refit without each fold in turn."""
    for fold in np.unique(assignment):
        held = assignment == fold
        kept = (~held).astype(float)
        yield (
            held,
            fitting.fit(problem, fitted.x, fitted.effects, weights=kept, spread=fitted.spread, steps=15),
        )


def judged(problem: Problem, folds: Iterable[Fold]) -> HeldOut:
    """How fits do on the clusters that each of them has not seen."""
    log_likelihood, missed = np.zeros(problem.n_cluster), dict[str, Miss]()
    estimates: dict[str, list[np.ndarray]] = {}
    doubt = 0.0
    for held, part in folds:
        earlier = on_earlier_data(problem, part)
        log_likelihood[held] = marginal(problem, part)[held] + earlier.value / problem.n_cluster
        doubt += earlier.variance * held.mean()
        for name, miss in problem.compiled.misses(part.x).items():
            before = missed.get(name, Miss(0.0, 0.0, 0.0))
            missed[name] = Miss(*(b + np.where(held, m, 0.0) for b, m in zip(before, miss, strict=True)))
        for block in (b for name in part.effects for b in problem.blocks_of(name) if not b.local):
            estimates.setdefault(block.name, []).append(part.x[block.index[0]])
    return HeldOut(log_likelihood, missed, {n: np.stack(v) for n, v in estimates.items()}, doubt)


@dataclass(frozen=True)
class Floor:
    """The best achievable total log likelihood of held-out clusters, in nats, as far as it is known.

    Attributes:
        low, high: bracket of what the causes, with their parameters as they are fitted, and whatever is left could reach.
        parameters: d of the causes.
        estimation: what not knowing them costs on average, see `cost`; half a chi-square of d degrees, scaled alike.
    """

    low: float
    high: float
    parameters: float = 0.0
    estimation: float = 0.0

    @property
    def best(self) -> float:
        """Its optimistic end."""
        return self.high + self.estimation

    @property
    def middle(self) -> float:
        """As likely too low as too high."""
        return float(self._at(np.array(0.5), np.array(0.5)))

    def draws(self, count: int, key: jax.Array) -> np.ndarray:
        """What it may be, (count,)."""
        return self._at(*np.asarray(jax.random.uniform(key, (2, count))))

    def _at(self, part: np.ndarray, level: np.ndarray) -> np.ndarray:
        """At a part of the way from low to high, estimation costing a quantile of what it may."""
        half = self.parameters / 2
        scale = special.gammaincinv(half, level) / half if half else 0.0
        return self.low + part * (self.high - self.low) + scale * self.estimation


def floor(problem: Problem, full: fitting.Fit, after: HeldOut, remaining_gain: float, n_folds: int) -> Floor:
    """What the causes at best could reach.

    Args:
        problem: in which the causes are live.
        full: the fit with the causes to all clusters.
        after: held-out results with the causes.
        remaining_gain: nats that moving any one site freely would still gain, 0 where nothing is significant.
        n_folds: K.
    """
    size = sum(e.dimension for e in problem.effects if e.name in full.effects)
    reached = float(after.log_likelihood.sum())
    return Floor(reached, reached + max(remaining_gain, 0.0), size, cost(size, n_folds))


def cost(parameters: float, n_folds: int) -> float:
    """Nats on held-out clusters that estimating d parameters from the share (K - 1) / K of all costs, d / 2 K / (K - 1)."""
    return 0.5 * parameters * n_folds / (n_folds - 1)


def closed_fraction(
    before: HeldOut, after: HeldOut, best: Floor, key: jax.Array, draws: int = 2000
) -> ClosedFraction | None:
    """Closed fraction with its 90% interval.

    Args:
        before: held-out results without the causes.
        after: held-out results with them.
        best: what can be reached.
        key: for the bootstrap over clusters.
        draws: bootstrap draws.
    """
    gain, totals = _gains(before, after, key, draws)
    if gain.sum() <= 0 or np.quantile(totals, 0.05) <= 0:
        return None
    return share(before, after, best, key, draws)


def share(before: HeldOut, after: HeldOut, best: Floor, key: jax.Array, draws: int = 2000) -> ClosedFraction:
    """The closed fraction of a gap that is known to be there, below zero where the loss grows; see `closed_fraction`."""
    gain, totals = _gains(before, after, key, draws)
    reached = float(after.log_likelihood.sum())
    remainder = best.draws(draws, jax.random.fold_in(key, 1)) - reached
    low, high = np.quantile(_fraction(totals, remainder), [0.05, 0.95])
    centre = float(_fraction(gain.sum(), best.middle - reached))
    return ClosedFraction(float(np.clip(centre, low, high)), float(low), float(high))


def _fraction(gain: ArrayLike, rest: ArrayLike) -> np.ndarray:
    """What a gain closes where a rest is left, -1 at worst."""
    gain = np.asarray(gain)
    whole = np.maximum(np.maximum(gain, 0.0) + np.maximum(rest, 0.0), np.abs(gain))
    return gain / np.maximum(whole, 1e-300)


def _gains(before: HeldOut, after: HeldOut, key: jax.Array, draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Gain of each cluster, and its totals over bootstrap draws of the clusters and of what earlier data say by chance."""
    gain = after.log_likelihood - before.log_likelihood
    index = np.asarray(jax.random.randint(key, (draws, len(gain)), 0, len(gain)))
    chance = np.asarray(jax.random.normal(jax.random.fold_in(key, 2), (draws,)))
    return gain, gain[index].sum(1) + np.sqrt(max(before.doubt - after.doubt, 0.0)) * chance
