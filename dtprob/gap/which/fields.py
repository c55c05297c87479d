"""Tests of variance effects: are the scores of a random field larger than the fitted model allows?

One-sided second-order score tests, each with a few weightings of the field's entries, calibrated by replicates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.bootstrap import Replicates
from dtprob.gap.model.problem import Problem
from dtprob.gap.tails import deviation, family_wise, field_log_bayes_factor, gamma_tail
from dtprob.gap.which.directions import Surroundings
from dtprob.gap.which.places import Placed

_SPREADS: Final = np.geomspace(1e-2, 1e3, 51)
"""Spreads that are tried, in units of what a weight of middling information is known to."""


class FieldTests(NamedTuple):
    """Results for each variance effect.

    Attributes:
        smallest: smallest p-value over weightings.
        p_value: the same, with the choice of the weighting accounted for.
        z: largest normal quantile over weightings.
        log_bayes_factor: rough, of the best weighting.
        replicates: smallest p-value over weightings of each replicate.
    """

    smallest: Float[np.ndarray, " effect"]
    p_value: Float[np.ndarray, " effect"]
    z: Float[np.ndarray, " effect"]
    log_bayes_factor: Float[np.ndarray, " effect"]
    replicates: Float[np.ndarray, "replicate effect"]


def tests_of_fields(
    problem: Problem,
    around: Surroundings,
    fields: Sequence[Effect],
    drawn: Replicates,
    placed: Mapping[str, Placed],
) -> FieldTests:
    """Test variance effects, those that may act anywhere where they were found.

    Args:
        problem: the model and candidates on their data.
        around: the fit.
        fields: the effects.
        drawn: the data and replicates there.
        placed: how the places of effects that may act anywhere were found, by name.
    """
    energy: dict[str, np.ndarray] = {}
    values = around.grown() if fields else {}
    for part in drawn.parts() if fields else ():
        found = problem.programs.field_energy(values, part, fields)
        energy = {n: np.concatenate([energy[n], e[1:]]) if energy else e for n, e in found.items()}
    tested = field_tests(energy, [e.name for e in fields], drawn.at_sites)
    for k, found in ((k, placed[e.name]) for k, e in enumerate(fields) if e.name in placed):
        tested.smallest[k] = tested.p_value[k] = found.p_value
        tested.replicates[:, k], tested.z[k] = 1.0, deviation(found.p_value, one_sided=True)
        tested.log_bayes_factor[k] -= found.price
    return tested


def field_tests(
    energies: Mapping[str, Float[np.ndarray, "n weighting"]], names: Sequence[str], n: int
) -> FieldTests:
    """Test variance effects. One whose energies are not finite, as of a rewrite without a slope, tells nothing.

    Args:
        energies: weighted sums of squared scores, of the data and then of replicates.
        names: the effects, in the order of the results.
        n: number of replicates.
    """
    smallest, p_value, z, bayes, replicates = [], [], [], [], np.ones((n, len(names)))
    for k, name in enumerate(names):
        told = energies[name] if np.isfinite(energies[name]).all() else np.zeros_like(energies[name])
        observed, null = told[0], told[1:]
        mean, variance = null.mean(axis=0), null.var(axis=0)
        p, quantile = gamma_tail(observed, mean, variance)
        null_p = gamma_tail(null, mean, variance)[0].min(axis=1)
        smallest.append(float(p.min()))
        p_value.append(float(family_wise(p.min()[None], null_p)[0]))
        z.append(float(quantile.max()))
        bayes.append(float(field_log_bayes_factor(observed, mean, variance).max()))
        replicates[:, k] = null_p
    return FieldTests(np.array(smallest), np.array(p_value), np.array(z), np.array(bayes), replicates)


def common_spread(
    scores: Float[np.ndarray, " weight"], information: Float[np.ndarray, " weight"]
) -> tuple[float, float]:
    """Standard deviation of independent normal weights with the largest evidence, and its log Bayes factor.

    log BF(s) = 1/2 sum_k (s^2 u_k^2 / (1 + s^2 J_k) - log(1 + s^2 J_k)).

    Args:
        scores: u, of the weights at zero.
        information: J of each weight.
    """
    spreads, terms = spread_terms(scores, information)
    evidence = terms.sum(axis=1)
    best = int(evidence.argmax())
    return float(spreads[best]), max(float(evidence[best]), 0.0)


def spread_terms(
    scores: Float[np.ndarray, " weight"], information: Float[np.ndarray, " weight"]
) -> tuple[Float[np.ndarray, " spread"], Float[np.ndarray, "spread weight"]]:
    """The spreads that are tried, and what each weight adds to the log Bayes factor of each; see `common_spread`."""
    seen = information > 1e-12 * max(float(information.max(initial=0.0)), 1e-300)
    spreads = _SPREADS / np.sqrt(np.median(information[seen]) if seen.any() else 1.0)
    u, j = np.where(seen, scores, 0.0), np.where(seen, information, 0.0)
    square = spreads[:, None] ** 2
    inflated = 1 + square * j
    return spreads, 0.5 * (square * u**2 / inflated - np.log(inflated))
