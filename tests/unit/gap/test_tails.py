"""The largest of many squared scores, against what replicates say."""

import numpy as np
import pytest
from scipy import stats

from dtprob.gap.tails import gamma_tail, largest_tail


def test_the_largest_of_normal_scores_is_uniform():
    rng = np.random.default_rng(0)
    values = [largest_tail((rng.standard_normal((200, 500)) ** 2).max(1))[-1] for _ in range(400)]
    for level in (0.01, 0.1):
        assert (np.array(values) <= level).sum() <= stats.binom.isf(1e-3, 400, 1.5 * level)
    assert stats.kstest(values, "uniform").statistic < 0.1


@pytest.mark.parametrize("alike", [[1.0] * 40, [1.0, 1.0 + 1e-14] * 20, [0.0] * 40])
def test_replicates_all_alike_say_nothing(alike):
    np.testing.assert_array_equal(largest_tail(np.array([*alike, 50.0])), 1.0)


def test_far_below_the_mean_the_quantile_is_finite():
    """A link in which hardly any misfit is left is no link without data."""
    shape = 20.0
    for value in (1e-3, 0.5, 5.0, 19.0):
        p, z = gamma_tail(np.array([value]), np.array([shape]), np.array([shape]))
        assert p[0] == pytest.approx(stats.gamma(shape).sf(value))
        assert z[0] == pytest.approx(stats.norm.ppf(max(stats.gamma(shape).cdf(value), 1e-300)), abs=1e-6)
    assert gamma_tail(np.zeros(1), np.zeros(1), np.zeros(1))[1][0] == -np.inf
