"""The circular complex normal distribution against its two real parts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from dtprob.models.complex_normal import ComplexNormal

LOC, VARIANCE = np.array([1 - 2j, 0.3j, -1.0]), np.array([[0.5], [2.0]])


def test_density_is_that_of_both_parts():
    value = np.array([0.2 + 1j, -1.0, 2 - 2j])
    half = np.sqrt(VARIANCE / 2)
    expected = stats.norm.logpdf(value.real, LOC.real, half) + stats.norm.logpdf(value.imag, LOC.imag, half)
    np.testing.assert_allclose(ComplexNormal(LOC, VARIANCE).log_prob(value), expected, rtol=1e-12)


def test_draws_have_the_moments():
    n = 20_000
    draws = np.asarray(ComplexNormal(LOC, VARIANCE).sample(jax.random.key(0), (n,)))
    assert draws.shape == (n, 2, 3)
    error = draws.mean(axis=0) - LOC
    assert np.all(np.abs(error) < 5 * np.sqrt(VARIANCE / n))
    spread = np.mean(np.abs(draws - LOC) ** 2, axis=0)
    np.testing.assert_allclose(spread, np.broadcast_to(VARIANCE, (2, 3)), rtol=5 / np.sqrt(n))
    pseudo = np.mean((draws - LOC) ** 2, axis=0)
    assert np.all(np.abs(pseudo) < 5 * np.sqrt(2) * VARIANCE / np.sqrt(n))


def test_gradients_agree_with_differences():
    def total(parameters):
        real, imaginary, level = parameters
        return ComplexNormal(jax.lax.complex(real, imaginary), jnp.exp(level)).log_prob(0.4 - 0.7j)

    at, step = jnp.array([0.3, -0.2, 0.5]), 1e-6
    for j in range(3):
        moved = [total(at.at[j].add(sign * step)) for sign in (1, -1)]
        assert jax.grad(total)(at)[j] == pytest.approx(float(moved[0] - moved[1]) / (2 * step), rel=1e-7)


def test_shapes_and_mean():
    wide = ComplexNormal(LOC, VARIANCE)
    assert wide.batch_shape == (2, 3)
    assert wide.event_shape == ()
    np.testing.assert_array_equal(wide.mean, np.broadcast_to(LOC, (2, 3)))
