"""Sizes that would be noticed nine times in ten, against simulated scores."""

import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.which.detectable import detectable

LEVEL = 1e-3


def moving(*parameters):
    return Effect("moved", {"level": lambda value, p, context: value}, parameters)


@pytest.mark.parametrize("directions", [1, 2, 9, 30])
def test_an_effect_of_the_told_size_is_noticed_nine_times_in_ten(directions):
    information = np.linspace(1.0, 4.0, directions)
    effect = moving(Parameter("shift", dist.Normal(0.0, 1.0).expand((directions,))))
    found = detectable(effect, information, directions, LEVEL)
    rng, count = np.random.default_rng(0), 40_000
    scores = rng.normal(size=(count, directions))
    scores[:, -1] += found.size * np.sqrt(information[-1])
    p = stats.chi2.sf((scores**2).sum(axis=1), directions)
    noticed = int((p < LEVEL).sum())
    low, high = stats.binom.interval(1 - 1e-6, count, 0.9)
    assert low <= noticed <= high


def test_a_size_of_one_sign_is_noticed_on_its_side_only():
    effect = moving(Parameter("spread", dist.HalfNormal(1.0)))
    found = detectable(effect, np.array([4.0]), 1, LEVEL)
    assert stats.norm.sf(stats.norm.isf(LEVEL) - 2.0 * found.size) == pytest.approx(0.9)


def test_the_size_is_of_the_parameter_that_shows_most_at_its_usual_size():
    faint, clear = (
        Parameter("faint", dist.Normal(0.0, 0.1)),
        Parameter("clear", dist.Normal(0.0, 2.0), unit="m"),
    )
    found = detectable(moving(faint, clear), np.array([4.0, 1.0]), 2, LEVEL)
    assert found.parameter is clear


def test_what_no_score_tells_of_is_never_noticed():
    found = detectable(moving(Parameter("shift", dist.Normal(0.0, 1.0))), np.zeros(1), 0, LEVEL)
    assert found.size is None
    assert found.parameter.name == "shift"
