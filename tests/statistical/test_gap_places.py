"""Effects that may act anywhere ring no more alarms than they are allowed to."""

import jax
import numpy as np
import pytest
from scipy import stats

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.bootstrap import replicate
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.which.places import place
from tests.statistical.test_gap_screening import use
from tests.unit.gap.examples import bump, draw, inputs, line, raised, ripple

FAST = Settings(replicates=99, site_replicates=99)
MISSED = 1e-3
"""Chance that a right test fails here, of each bound."""


@pytest.fixture(scope="module")
def chance():
    """Function (shift, seed) -> p-value of the bump at its best place."""
    problem = Problem(line, draw("line"), [bump(), ripple()])

    def of(shift, seed):
        use(problem, draw("line", seed=seed, shift=shift))
        base = fitting.fit(problem, np.zeros(problem.dimension))
        drawn = replicate(problem, base, project(problem, base), jax.random.key(seed), FAST)
        return place(problem, base, drawn)[1]["bump"].p_value

    return of


@pytest.mark.study
def test_a_best_place_by_chance_is_paid_for(chance):
    p = np.array([chance(0.0, seed) for seed in range(1, 121)])
    for level in (0.02, 0.05, 0.2):
        assert (p < level).sum() <= stats.binom.isf(MISSED, len(p), level)
    assert (p < 0.5).sum() >= stats.binom.ppf(MISSED, len(p), 0.1)  # the price is careful, up to a few times


def test_a_bump_anywhere_is_noticed(chance):
    places = np.random.default_rng(0).uniform(-1.5, 1.5, 20)
    p = np.array([chance(raised(inputs(), at, 2.0), 1 + k) for k, at in enumerate(places)])
    assert (p < 0.005).sum() >= stats.binom.ppf(MISSED, len(p), 0.9)
