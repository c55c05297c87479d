"""Bootstrap intervals against the sandwich and against resampling by hand."""

import jax
import numpy as np
import pytest

from dtprob.models.prediction_powered.bootstrap import bootstrap, bootstrap_draws, resample
from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.quantile import Quantile
from tests.unit.models.prediction_powered.examples import linear, scalar

KEY = jax.random.key(9)


def test_resamples_are_of_the_right_size_and_spread():
    random = np.random.default_rng(9)
    counts = np.stack([resample(random, 30) for _ in range(2000)])
    np.testing.assert_array_equal(counts.sum(axis=1), 30)
    # Each count is binomial with variance 29/30; the mean over 60000 of them is known to 1%.
    assert counts.var() == pytest.approx(29 / 30, rel=0.04)


@pytest.mark.parametrize("loss", ["mean", "ols"])
def test_the_spread_of_the_resamples_is_the_sandwich(loss):
    sample = linear(n=150)
    found = estimate(loss, sample)
    draws = bootstrap_draws(KEY, loss, sample, found, 2000)
    np.testing.assert_allclose(draws.mean(axis=0), found.theta, atol=0.2 * found.standard_error.max())
    np.testing.assert_allclose(draws.std(axis=0), found.standard_error, rtol=0.12)


def test_basic_intervals_mirror_percentile_ones():
    sample = scalar()
    found = estimate("mean", sample)
    percentile, basic = (
        bootstrap(KEY, "mean", sample, found, draws=300, method=method) for method in ("percentile", "basic")
    )
    np.testing.assert_allclose(basic.low, 2 * found.theta - percentile.high, rtol=1e-12)
    np.testing.assert_allclose(basic.high, 2 * found.theta - percentile.low, rtol=1e-12)
    assert percentile.low[0] < found.theta[0] < percentile.high[0]


def test_quantiles_have_bootstrap_intervals():
    sample = scalar(n=200)
    found = estimate(Quantile(0.5), sample)
    resampled = bootstrap(KEY, Quantile(0.5), sample, found, draws=1000)
    widths = [float((one.high - one.low)[0]) for one in (found, resampled)]
    assert widths[1] == pytest.approx(widths[0], rel=0.3)
