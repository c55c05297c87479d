"""The largest of many squared scores, against what replicates say."""

import numpy as np
import pytest
from scipy import stats

from dtprob.gap.tails import largest_tail


def test_the_largest_of_normal_scores_is_uniform():
    rng = np.random.default_rng(0)
    values = [largest_tail((rng.standard_normal((200, 500)) ** 2).max(1))[-1] for _ in range(400)]
    for level in (0.01, 0.1):
        assert (np.array(values) <= level).sum() <= stats.binom.isf(1e-3, 400, 1.5 * level)
    assert stats.kstest(values, "uniform").statistic < 0.1


@pytest.mark.parametrize("alike", [[1.0] * 40, [1.0, 1.0 + 1e-14] * 20, [0.0] * 40])
def test_replicates_all_alike_say_nothing(alike):
    np.testing.assert_array_equal(largest_tail(np.array([*alike, 50.0])), 1.0)
