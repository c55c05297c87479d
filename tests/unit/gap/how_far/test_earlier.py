"""What a fit costs on earlier data: nothing on average where nothing has changed, and then no effect closes a gap."""

import jax
import numpy as np
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting.fit import fit
from dtprob.gap.how_far import closed
from dtprob.gap.how_far.earlier import on_earlier_data
from dtprob.gap.model.problem import Problem
from tests.unit.gap.examples import draw, line

RAISED = Effect("raised", {"mean": lambda v, p, c: v + p["by"]}, (Parameter("by", dist.Normal(0.0, 2.0)),))
COUNT = 60
"""Data sets."""


class Earlier:
    """Draws of the line's parameters, of which the slope is known and the level to a spread."""

    def __init__(self, spread):
        self.spread = spread

    def sample(self, key, n):
        noise = np.asarray(jax.random.normal(key, (2, n)))
        return {"a": 0.7 + self.spread * noise[0], "b": -1.2 + 0.01 * noise[1]}


def drawn(spread, count):
    """Problems whose level is drawn as the reference says, and their fits."""
    rng = np.random.default_rng(5)
    for seed in range(1, count + 1):
        data = draw("line", seed=seed, shift=spread * rng.normal())
        problem = Problem(line, data, [RAISED], None, Earlier(spread))
        yield problem, fit(problem, problem.null())


@pytest.mark.study
@pytest.mark.parametrize("spread", [1.0, 0.05])
def test_it_is_nothing_on_average_and_as_uncertain_as_it_says(spread):
    found = [on_earlier_data(problem, fitted) for problem, fitted in drawn(spread, COUNT)]
    values, variances = np.array(found).T
    assert abs(values.mean()) < 4 * np.sqrt(variances.mean() / COUNT)
    assert 0.4 < values.var() / variances.mean() < 2.5


@pytest.mark.study
@pytest.mark.parametrize("spread", [0.05, 1.0])
def test_an_effect_that_does_what_a_known_parameter_does_closes_no_gap_by_chance(spread):
    """At most 1 in 20 establish one; of 30 more than 6 would with probability 6e-4."""
    established = 0
    for problem, fitted in drawn(spread, COUNT // 2):
        wide = problem.with_live(["raised"])
        full = fit(wide, wide.translate(fitted.x, problem), ["raised"])
        folds = closed.folds(problem.n_cluster, 5)
        before, after = closed.cross_fit(problem, fitted, folds), closed.cross_fit(wide, full, folds)
        floor = closed.floor(wide, full, after, 0.0, 5)
        established += closed.closed_fraction(before, after, floor, jax.random.key(0)) is not None
    assert established <= 6


def test_without_a_reference_it_is_nothing():
    problem = Problem(line, draw("line"), [RAISED])
    assert on_earlier_data(problem, fit(problem, problem.null())) == (0.0, 0.0)
