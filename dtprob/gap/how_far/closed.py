"""How far: the share of the gap that the causes close, on clusters that the fit has not seen.

G = (L0 - L1) / (L0 - L*), with losses in nats on held-out clusters; the nuisances are refitted in L0, so that calibration
error is not credited to an effect. The interval is a paired bootstrap over clusters and over what the floor may be.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike
from scipy import special, stats

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.determined import shared_weights
from dtprob.gap.fitting.marginal import marginal
from dtprob.gap.fitting.refit import at_null_except
from dtprob.gap.how_far.earlier import on_earlier_data
from dtprob.gap.keys import key_for
from dtprob.gap.model.misses import Miss
from dtprob.gap.model.problem import Problem

_TOLD: Final = 1.0
"""Nats that an effect changes, for better or worse, in clusters that a fold keeps, up to which they do not tell of it."""


@dataclass(frozen=True)
class HeldOut:
    """Cross-fitted results of a set of effects.

    Attributes:
        log_likelihood: held-out log marginal likelihood of each cluster (cluster,), with its part of what the fits cost
            on earlier data.
        misses: by how much predictions miss each cluster, by observed site and measure.
        estimates: the effects' parameters in each fold, {site name: (fold, *shape flattened)}.
        doubt: variance of what the fits cost on earlier data, where nothing has changed since.
        alone: clusters that are the only ones to tell of an effect; see `Fold`.
    """

    log_likelihood: np.ndarray
    misses: Mapping[str, Miss]
    estimates: dict[str, np.ndarray]
    doubt: float = 0.0
    alone: Int[np.ndarray, " few"] = field(default_factory=lambda: np.zeros(0, int))


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


class Fold(NamedTuple):
    """Some clusters, and a fit to the others.

    Of an effect that acts in one cluster, such as the fault of one device, the others tell nothing. Its parameters are then
    those of the fit to all, and that cluster is charged what fitting them to it gains by itself and loses on new data, a
    nat each (Akaike, IEEE Trans. Autom. Control 19 (1974) 716), and the choice among the effects of its family.

    Attributes:
        held: the clusters (cluster,) that were left out.
        fitted: the fit.
        charged: nats (cluster,), 0 where the others tell.
    """

    held: Bool[np.ndarray, " cluster"]
    fitted: fitting.Fit
    charged: Float[np.ndarray, " cluster"]


def cross_fit(problem: Problem, fitted: fitting.Fit, assignment: np.ndarray) -> HeldOut:
    """Refit without each fold in turn, and judge the fold."""
    return judged(problem, fold_fits(problem, fitted, assignment))


def fold_fits(problem: Problem, fitted: fitting.Fit, assignment: np.ndarray) -> Iterator[Fold]:
    """Refit without each fold in turn."""
    gains = _gained(problem, fitted)
    for fold in np.unique(assignment):
        held = assignment == fold
        kept = (~held).astype(float)
        part = fitting.fit(problem, fitted.x, fitted.effects, weights=kept, spread=fitted.spread, steps=15)
        yield _completed(problem, fitted, Fold(held, part, np.zeros(len(held))), gains)


def _gained(problem: Problem, fitted: fitting.Fit) -> dict[str, np.ndarray]:
    """Nats that each mean effect of a fit gains in each cluster (cluster,), all else as it is."""
    here = problem.compiled.evaluate(fitted.x)[0]
    gains: dict[str, np.ndarray] = {}
    for effect in (e for e in problem.effects if e.name in fitted.effects and e.kind == "mean"):
        others = [name for name in fitted.effects if name != effect.name]
        without = problem.compiled.evaluate(at_null_except(problem, fitted, others))[0]
        gains[effect.name] = np.nan_to_num(np.asarray(here - without))
    return gains


def _completed(problem: Problem, fitted: fitting.Fit, fold: Fold, gains: Mapping[str, np.ndarray]) -> Fold:
    """The fold with the parameters of effects of which the clusters that it keeps tell nothing."""
    x, covariance, charged = fold.fitted.x.copy(), fold.fitted.covariance.copy(), fold.charged.copy()
    for effect in (e for e in problem.effects if e.name in gains):
        gain = gains[effect.name]
        telling = fold.held & (gain > _TOLD)
        if not telling.any() or np.abs(gain[~fold.held]).sum() > _TOLD:
            continue
        index = problem.layout.of(effect)
        x[index] = fitted.x[index]
        place = np.searchsorted(fitted.global_index, index)
        covariance[place], covariance[:, place] = 0.0, 0.0
        covariance[np.ix_(place, place)] = fitted.covariance[np.ix_(place, place)]
        choice = np.log(sum(e.family == effect.family for e in problem.effects))
        charged[telling] += (effect.dimension + choice) / telling.sum()
    return Fold(fold.held, replace(fold.fitted, x=x, covariance=covariance), charged)


def judged(problem: Problem, folds: Iterable[Fold]) -> HeldOut:
    """How fits do on the clusters that each of them has not seen."""
    log_likelihood, missed = np.zeros(problem.n_cluster), dict[str, Miss]()
    estimates: dict[str, list[np.ndarray]] = {}
    doubt, alone = 0.0, np.zeros(problem.n_cluster, bool)
    for held, part, charged in folds:
        earlier = on_earlier_data(problem, part)
        seen = marginal(problem, part) - charged
        log_likelihood[held] = seen[held] + earlier.value / problem.n_cluster
        alone |= charged > 0
        doubt += earlier.variance * held.mean()
        for name, miss in problem.compiled.misses(part.x).items():
            before = missed.get(name, Miss(0.0, 0.0, 0.0))
            missed[name] = Miss(*(b + np.where(held, m, 0.0) for b, m in zip(before, miss, strict=True)))
        for effect in (e for e in problem.effects if e.name in part.effects):
            for parameter in effect.parameters:
                name = effect.site_name(parameter.name)
                estimates.setdefault(name, []).append(_estimate(problem, part, effect, parameter))
    stacked = {n: np.stack(v) for n, v in estimates.items()}
    return HeldOut(log_likelihood, missed, stacked, doubt, np.flatnonzero(alone))


def _estimate(
    problem: Problem, fitted: fitting.Fit, effect: Effect, parameter: Parameter
) -> Float[np.ndarray, " entry"]:
    """A parameter at a fit; the size of a variance effect is the spread of its field."""
    if parameter in effect.fitted:
        return fitted.x[problem.layout[effect.site_name(parameter.name)].index[0]]
    return np.array([fitted.spread[effect.name]])


@dataclass(frozen=True)
class Floor:
    """The best achievable total log likelihood of held-out clusters, in nats, as far as it is known.

    Attributes:
        low, high: bracket of what the causes, with their parameters as they are fitted, and whatever is left could reach.
        parameters: d of the causes, with the entries of random fields that clusters share, as far as the data tell them.
        estimation: what not knowing them costs on average, see `cost`; half a chi-square of d degrees, scaled alike.
        but_for_fields: both without the entries of fields.
    """

    low: float
    high: float
    parameters: float = 0.0
    estimation: float = 0.0
    but_for_fields: tuple[float, float] = (0.0, 0.0)

    @property
    def of_known_fields(self) -> Floor:
        """The same if the entries of random fields were known."""
        parameters, estimation = self.but_for_fields
        return replace(self, parameters=parameters, estimation=estimation)

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
        remaining_gain: nats that moving any one site freely would still gain, as far as it is likely that one is wrong.
        n_folds: K.
    """
    effects = [e for e in problem.effects if e.name in full.effects]
    size = sum(e.dimension for e in effects)
    entries = sum(shared_weights(problem, full, e.name) for e in effects if e.kind == "variance")
    reached = float(after.log_likelihood.sum())
    estimation, known = cost(size + entries, n_folds), cost(size, n_folds)
    return Floor(reached, reached + max(remaining_gain, 0.0), size + entries, estimation, (size, known))


def shown(best: Floor, after: HeldOut, beyond: HeldOut) -> Floor:
    """The floor once a model of what is left has shown on held-out clusters how much that is, within a standard error.

    Args:
        best: the floor that scores alone tell.
        after: held-out results with the causes.
        beyond: the same with what is left modelled, too.
    """
    gain = beyond.log_likelihood - after.log_likelihood
    error = float(np.sqrt(len(gain)) * gain.std(ddof=1))
    low, high = (best.low + max(float(gain.sum()) + side * error, 0.0) for side in (-1, 1))
    return replace(best, low=low, high=max(best.high, high if low > best.low else best.low))


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
    if not (np.isfinite(gain).all() and gain.sum() > 0 and np.quantile(totals, 0.05) > 0):
        return None
    return share(before, after, best, key, draws)


def share(before: HeldOut, after: HeldOut, best: Floor, key: jax.Array, draws: int = 2000) -> ClosedFraction:
    """The closed fraction of a gap that is known to be there, below zero where the loss grows; see `closed_fraction`."""
    gain, totals = _gains(before, after, key, draws)
    reached = float(after.log_likelihood.sum())
    remainder = best.draws(draws, key_for(key, "floor")) - reached
    low, high = np.quantile(_fraction(totals, remainder), [0.05, 0.95])
    centre = float(_fraction(gain.sum(), best.middle - reached))
    return ClosedFraction(float(np.clip(centre, low, high)), float(low), float(high))


def _fraction(gain: ArrayLike, rest: ArrayLike) -> np.ndarray:
    """What a gain closes where a rest is left, -1 at worst."""
    gain = np.asarray(gain)
    whole = np.maximum(np.maximum(gain, 0.0) + np.maximum(rest, 0.0), np.abs(gain))
    return gain / np.maximum(whole, 1e-300)


def _gains(before: HeldOut, after: HeldOut, key: jax.Array, draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Gain of each cluster, and its totals over bootstrap draws of the clusters and of what earlier data say by chance.

    The gain g of clusters that tell alone of an effect is a log likelihood ratio, of variance 2 g. The draws stray too
    little from the total by the degree of freedom that its mean takes, and a few clusters have the tails of Student's t.
    """
    gain = after.log_likelihood - before.log_likelihood
    own = gain[after.alone].sum()
    chance = np.asarray(jax.random.normal(key_for(key, "width"), (draws,)))
    variance = max(before.doubt - after.doubt, 0.0) + 2 * max(own, 0.0)
    total, free = gain.sum(), max(len(gain) - len(after.alone) - 1, 1)
    stretch = np.sqrt((free + 1) / free) * stats.t.ppf(0.95, free) / stats.norm.ppf(0.95)
    drawn = gain[resampled(len(gain), after.alone, key_for(key, "clusters"), draws)].sum(1)
    return gain, total + stretch * (drawn - total) + np.sqrt(variance) * chance


def resampled(
    n_cluster: int, alone: Int[np.ndarray, " few"], key: jax.Array, draws: int
) -> Int[np.ndarray, "draw cluster"]:
    """Bootstrap draws of clusters, in each of which those are that tell alone of an effect."""
    others = np.setdiff1d(np.arange(n_cluster), alone)
    index = np.asarray(jax.random.randint(key, (draws, len(others)), 0, max(len(others), 1)))
    return np.concatenate([others[index], np.broadcast_to(alone, (draws, len(alone)))], axis=1)
