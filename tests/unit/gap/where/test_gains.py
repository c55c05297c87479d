"""What moves promise to gain, against log likelihoods of normal readings."""

import numpy as np
from scipy import optimize

from dtprob.gap.where.gains import gains


def test_moves_of_locations_gain_as_a_quadratic():
    rng = np.random.default_rng(0)
    rows, shifts = rng.normal(size=(3, 4, 5)), rng.normal(size=(3, 4, 5))
    slope, curvature = (rows * shifts).sum((1, 2)), (shifts**2).sum((1, 2))
    found = gains(rows, shifts, np.zeros((4, 5), bool))
    np.testing.assert_allclose(found, 0.5 * slope**2 / curvature)


def test_a_spread_that_is_far_too_small_gains_as_its_likelihood_says():
    """A quarter of the readings four times as noisy as told: to first order this gains ten times too much."""
    r = np.random.default_rng(1).normal(size=400) * np.where(np.arange(400) < 100, 4.0, 1.0)
    rows = ((r**2 - 1) / np.sqrt(2))[None, :, None]
    shifts = np.where(np.arange(400) < 100, 1.0, 0.0)[None, :, None]

    def gained(log_scale):
        return (-log_scale + 0.5 * r[:100] ** 2 * (1 - np.exp(-2 * log_scale))).sum()

    exact = -optimize.minimize_scalar(lambda t: -gained(t), bounds=(0, 4), method="bounded").fun
    found = gains(rows, shifts, np.ones((400, 1), bool))[0]
    assert 0.9 * exact < found <= exact + 1e-9
    assert 0.5 * rows[0, :100].sum() ** 2 / 100 > 5 * exact


def test_small_moves_of_spreads_gain_as_a_quadratic():
    rng = np.random.default_rng(2)
    rows, shifts = 1e-3 * rng.normal(size=(1, 4, 5)), rng.normal(size=(1, 4, 5))
    slope, curvature = (rows * shifts).sum(), (shifts**2).sum()
    np.testing.assert_allclose(
        gains(rows, shifts, np.ones((4, 5), bool)), 0.5 * slope**2 / curvature, rtol=0.02
    )
