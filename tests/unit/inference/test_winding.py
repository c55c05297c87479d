"""Lifted angles keep their density exactly, and nothing diverges."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from dtprob.inference.circular import wrap
from dtprob.inference.winding import log_window, recentred, redraw_winding


def test_windows_sum_to_one_over_all_windings():
    for angle in (-3.0, 0.0, 1.7, np.pi):
        lifts = jnp.array([angle + 2 * np.pi * k for k in range(-8, 9)])
        total = sum(float(jnp.exp(log_window(u[None]))) for u in lifts)
        assert abs(total - 1) < 1e-12


def test_the_window_is_flat_inside_and_finite_outside():
    assert abs(float(log_window(jnp.zeros(1)))) < 0.01
    slope = jax.grad(lambda u: log_window(u[None]))
    assert abs(float(slope(jnp.asarray(0.5)))) < 0.01
    for far in (50.0, -1e6):
        assert np.isfinite(float(log_window(jnp.array([far]))))
        assert float(slope(jnp.asarray(far))) * far < 0


def test_redrawn_windings_keep_the_angle_and_follow_the_window():
    centre = jnp.full(20_000, 0.7)
    angle = jnp.full(20_000, 0.7 + 2.9)
    moved = redraw_winding(jax.random.key(0), angle, centre)
    np.testing.assert_allclose(wrap(moved), wrap(angle), atol=1e-9)
    stays = float(jnp.exp(log_window(jnp.array([2.9]))))
    count = int(jnp.sum(jnp.abs(moved - angle) < 1e-6))
    assert stats.binomtest(count, 20_000, stays).pvalue > 1e-3


def test_recentred_angles_lie_within_half_a_turn():
    angle = jnp.linspace(-20, 20, 101)
    moved = recentred(angle, jnp.full(101, 3.0))
    assert float(jnp.max(jnp.abs(moved - 3.0))) <= np.pi + 1e-9
    np.testing.assert_allclose(wrap(moved), wrap(angle), atol=1e-9)
