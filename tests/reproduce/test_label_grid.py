"""A few cells of the grid: the published numbers, no loss against the better scheme, intervals that cover."""

import jax
import numpy as np
import pytest
from scipy import stats

from dtprob.models.prediction_powered.tuning import Practice
from dtprob.physical.labels import Setting
from dtprob.reproduce.label_grid import study

RUNS = 3000


def covers(share, lowest, highest):
    """Whether a share of intervals that cover agrees with a probability in a range, but for one test in 10000."""
    bounds = stats.binom.ppf([5e-5, 1 - 5e-5], RUNS, [lowest, highest]) / RUNS
    return bounds[0] <= share <= bounds[1]


def test_the_anchors_for_the_mean():
    found = study(jax.random.key(1), RUNS, Setting("good", 50, 2000, 10), Practice(guard=False))
    # A mean square error over 3000 runs is known to 2.6%; four times that.
    np.testing.assert_allclose(found.error, [0.107, 0.0346, 0.0342], rtol=0.1)
    assert found.lam[2] == pytest.approx(0.91, abs=0.03)


@pytest.mark.parametrize("quality", ["perfect", "useless"])
def test_intervals_cover(quality):
    found = study(jax.random.key(2), RUNS, Setting(quality, 100, 2000, 5))
    assert covers(found.coverage[0], 0.9, 0.9)
    assert covers(found.coverage[2], 0.88, 0.92)


@pytest.mark.study
@pytest.mark.parametrize("quality", ["good", "useless"])
def test_the_tuned_scheme_does_not_lose(quality):
    found = study(jax.random.key(3), RUNS, Setting(quality, 100, 2000, 5))
    assert found.ratio < 1.03
