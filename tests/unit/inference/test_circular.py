"""Angles: wrapping, mean direction, resultant length, shortest arc."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtprob.inference.circular import arc_interval, mean_direction, resultant_length, wrap


@settings(deadline=None)
@given(st.floats(-1e4, 1e4))
def test_wrap_is_the_same_angle_inside(angle):
    wrapped = float(wrap(jnp.asarray(angle)))
    assert -np.pi < wrapped <= np.pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * angle), abs=1e-9)


def test_wrap_at_the_cut_and_its_slope():
    assert float(wrap(jnp.asarray(-jnp.pi))) == pytest.approx(np.pi)
    assert float(wrap(jnp.asarray(jnp.pi))) == pytest.approx(np.pi)
    assert float(jax.grad(wrap)(4.0)) == 1.0


def test_mean_direction_across_the_cut():
    angles = np.array([[3.0, 0.1], [-3.0, -0.3]])
    np.testing.assert_allclose(np.abs(mean_direction(angles)), [np.pi, 0.1], atol=1e-12)
    np.testing.assert_allclose(resultant_length(angles), np.cos([np.pi - 3.0, 0.2]), rtol=1e-12)


def test_arc_is_the_shortest_that_holds_the_share():
    angles = np.angle(np.exp(1j * (np.pi + np.linspace(-0.5, 0.5, 101))))
    low, high = arc_interval(angles, 0.9)
    assert low > high
    width = np.mod(high - low, 2 * np.pi)
    assert width == pytest.approx(0.9, abs=0.02)
    assert np.mean(np.mod(angles - low, 2 * np.pi) <= width + 1e-9) >= 0.9


def test_arc_of_one_angle_and_of_all():
    np.testing.assert_allclose(arc_interval(np.array([2.0])), [2.0, 2.0])
    low, high = arc_interval(np.linspace(-np.pi, np.pi, 400, endpoint=False), 1.0)
    assert np.mod(high - low, 2 * np.pi) == pytest.approx(2 * np.pi * 399 / 400)
