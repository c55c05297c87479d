"""Forward selection: the effect that improves a criterion most is added until none improves it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.refit import polished, refit, starting_points
from dtprob.gap.keys import key_for
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.withheld.rivals.claim import Claim
from dtprob.gap.withheld.rivals.criteria import bic, loo
from dtprob.gap.withheld.rivals.look import Look, chance, look

_NATS = 4.0
"""Difference of log predictive densities below which two models count as alike (Sivula et al., arXiv:2008.10296)."""
_DEVIATIONS = 2.0


class Criterion(NamedTuple):
    """How models are compared.

    Attributes:
        value: (problem, fit) -> terms whose sum is to be large.
        better: (terms of the larger model less those of the smaller one) -> whether the larger one is chosen.
        penalty: (parameters, observations) -> nats that an effect must bring, to first order.
    """

    value: Callable[[Problem, Fit], np.ndarray]
    better: Callable[[np.ndarray], bool]
    penalty: Callable[[np.ndarray, int], np.ndarray]


def _clearly(difference: np.ndarray) -> bool:
    error = np.sqrt(len(difference) * np.var(difference))
    return bool(difference.sum() > max(_NATS, _DEVIATIONS * error))


LOO = Criterion(loo, _clearly, lambda size, _: size)
BIC = Criterion(bic, lambda difference: bool(difference.sum() > 0), lambda size, n: 0.5 * size * np.log(n))


class Trials(NamedTuple):
    """The refits that add one effect to a fit, in a problem in which all of them are live."""

    problem: Problem
    fits: Mapping[str, Fit]


def _refitted(seen: Look, settings: Settings) -> Trials:
    """Refits with each of the most promising candidates."""
    order = np.argsort(-(seen.gain[0] - seen.size), kind="stable")
    chosen = [seen.names[i] for i in order[: settings.candidates] if seen.gain[0, i] > 0]
    problem = seen.problem.with_live([*seen.fitted.effects, *chosen])
    start = replace(seen.fitted, x=problem.translate(seen.fitted.x, seen.problem))
    effects = {e.name: e for e in problem.effects}
    means = [e.name for e in seen.scores.effects]
    fits = {}
    for name in chosen:
        step = seen.scores.step(means.index(name)) if name in means else None
        starts = starting_points(problem, start.x, effects[name], step, settings)
        fits[name] = refit(problem, start, effects[name], starts)
    return Trials(problem, {**fits, **polished(problem, start, fits, settings.polished)})


def forward(seen: Look, criterion: Criterion, key: jax.Array, settings: Settings) -> Claim:
    """Name the set where the criterion stops; rank by the criterion of single effects, then by first-order gain.

    Candidates that promise most to first order, at one nat per parameter, are refitted as a diagnosis does it, the best of
    them freed from local optima. The alarm is the largest gain of one effect less its penalty, to first order, so that it
    can be had of replicates.

    Args:
        seen: the base fit.
        criterion: how models are compared.
        key: of the replicates at later fits.
        settings: how many candidates are refitted at each step, and the largest set.
    """
    penalty = criterion.penalty(seen.size, seen.problem.observed.count)
    margin = seen.gain - penalty
    p_value = chance(margin.max(axis=1, initial=-np.inf))
    ranking = [seen.names[i] for i in np.argsort(-margin[0], kind="stable")]
    problem, fitted, here = seen.problem, seen.fitted, seen
    while True:
        terms, trials = criterion.value(problem, fitted), _refitted(here, settings)
        values = {name: criterion.value(trials.problem, fit) - terms for name, fit in trials.fits.items()}
        ordered = sorted(values, key=lambda name: -values[name].sum())
        if not fitted.effects:
            ranking = [*ordered, *(name for name in ranking if name not in values)]
        if not ordered or not criterion.better(values[ordered[0]]):
            break
        problem, fitted = trials.problem, trials.fits[ordered[0]]
        if len(fitted.effects) == settings.max_effects:
            break
        here = look(problem, fitted, key_for(key, f"step {len(fitted.effects)}"), settings)
    return Claim(p_value, fitted.effects, tuple(ranking))
