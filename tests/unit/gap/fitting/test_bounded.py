"""Normal vectors within bounds: probabilities against enumeration and integration, draws against the law."""

import numpy as np
import pytest
from scipy import stats

from dtprob.gap.fitting.bounded import Bounded, bounded_draws, log_positive


def test_independent_coordinates_are_exact():
    mean, sd = np.array([[0.3, -2.0, 8.0], [-9.0, 0.0, 1.0]]), np.array([1.0, 0.5, 3.0])
    covariance = np.broadcast_to(np.diag(sd**2), (2, 3, 3))
    np.testing.assert_allclose(
        log_positive(mean, covariance), stats.norm.logcdf(mean / sd).sum(axis=1), rtol=1e-12
    )


@pytest.mark.parametrize("correlation", [-0.4, 0.3, 0.9])
def test_correlated_coordinates_are_nearly_so(correlation):
    """Taken one by one, as if they were independent, three with correlation .9 would be off by .8 nats."""
    covariance = np.full((3, 3), correlation) + (1 - correlation) * np.eye(3)
    for mean in (np.zeros(3), np.array([0.5, -0.5, 1.0])):
        exact = stats.multivariate_normal(-mean, covariance).cdf(np.zeros(3))
        assert log_positive(mean[None], covariance[None])[0] == pytest.approx(np.log(exact), abs=0.06)


def test_draws_of_one_bounded_coordinate_have_its_law():
    """Of a truncated normal one by quantiles, and far out in a tail, where probabilities have no digits left."""
    for mean, low, high in ((0.2, 0.0, 1.0), (-40.0, 0.0, np.inf), (50.0, -np.inf, 0.0)):
        vector = Bounded(np.array([mean]), np.eye(1), np.array([low]), np.array([high]))
        draws = bounded_draws(vector, 4000, np.random.default_rng(0))[:, 0]
        assert low <= draws.min() <= draws.max() <= high
        if np.isfinite(high - low):
            law = stats.truncnorm(low - mean, high - mean, loc=mean)
            assert stats.kstest(draws, law.cdf).pvalue > 1e-3
        else:
            assert stats.kstest(np.abs(draws) * abs(mean), stats.expon.cdf).pvalue > 1e-3


def test_draws_of_a_vector_have_its_moments():
    """Two bounded and two free coordinates against rejection; unbounded vectors are what they were."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(4, 4))
    covariance, mean = root @ root.T, np.array([0.5, -0.3, 1.0, 0.0])
    low, high = np.array([0.0, -np.inf, -1.0, -np.inf]), np.array([np.inf, np.inf, 1.0, np.inf])
    plain = rng.multivariate_normal(mean, covariance, size=400_000)
    kept = plain[(plain >= low).all(axis=1) & (plain <= high).all(axis=1)]
    found = bounded_draws(Bounded(mean, covariance, low, high), 20_000, rng)
    error = kept.std(axis=0) / np.sqrt(20_000)
    assert (np.abs(found.mean(axis=0) - kept.mean(axis=0)) < 5 * error).all()
    np.testing.assert_allclose(
        np.cov(found.T), np.cov(kept.T), rtol=0.1, atol=0.05 * np.diag(covariance).max()
    )
    nowhere = np.full(4, np.inf)
    free = bounded_draws(Bounded(mean, covariance, -nowhere, nowhere), 20_000, rng)
    np.testing.assert_allclose(np.cov(free.T), covariance, rtol=0.1, atol=0.2)
