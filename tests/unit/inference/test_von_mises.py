"""Von Mises draws: their derivative in the concentration against finite differences and a known gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize, special

from dtprob.inference import von_mises

CONCENTRATIONS = [1e-3, 0.5, 3.0, 40.0, 2e3]


def probability(angle, kappa):
    """P(0 < z < angle), by quadrature."""
    density = lambda t: np.exp(kappa * (np.cos(t) - 1)) / (2 * np.pi * special.i0e(kappa))  # noqa: E731
    return integrate.quad(density, 0.0, angle, epsabs=1e-14, epsrel=1e-13, limit=200)[0]


@pytest.mark.parametrize("kappa", CONCENTRATIONS)
def test_slope_is_that_of_the_quantile(kappa):
    """z(kappa) with a fixed P(0 < z' < z), found by root finding at two concentrations."""
    scale = min(1.0, kappa**-0.5)
    for angle in np.asarray([0.1, 0.9, 1.8, 3.0]) * scale:
        level, step = probability(angle, kappa), 1e-3 * kappa

        def quantile(k, level=level):
            return optimize.brentq(lambda z: probability(z, k) - level, 0.0, np.pi, xtol=1e-14, rtol=1e-14)

        reference = (quantile(kappa + step) - quantile(kappa - step)) / (2 * step)
        for sign in (1, -1):
            found = von_mises.concentration_slope(jnp.asarray(sign * angle), jnp.asarray(kappa))
            assert float(found) == pytest.approx(sign * reference, rel=1e-5)


def test_the_gradient_of_a_mean_is_that_of_the_resultant():
    """d E[cos z] / d kappa = A'(kappa) = 1 - A / kappa - A^2; direction's gradient is -A sin mu; z-scores."""
    kappa, direction = jnp.asarray([0.3, 2.0, 30.0]), jnp.asarray([0.4, -2.0, 3.0])

    def cosines(kappa, direction):
        return jnp.cos(von_mises.sample(jax.random.key(1), direction, kappa, 20_000))

    ones = jnp.ones(3)
    _, slopes = jax.jvp(lambda k: cosines(k, jnp.zeros(3)), (kappa,), (ones,))
    _, turns = jax.jvp(lambda m: cosines(kappa, m), (direction,), (ones,))
    ratio = special.i1e(kappa) / special.i0e(kappa)
    known = (1 - ratio / np.asarray(kappa) - ratio**2, -ratio * np.sin(direction))
    for found, expected in zip((slopes, turns), known, strict=True):
        found = np.asarray(found)  # noqa: PLW2901
        z = (found.mean(0) - expected) / (found.std(0) / len(found) ** 0.5)
        assert np.max(np.abs(z)) < 4.5  # six z-scores at fixed keys: fails once in 25,000


def test_reverse_mode_reaches_the_concentration():
    slope = jax.grad(lambda k: jnp.sum(von_mises.sample(jax.random.key(0), jnp.zeros(()), k, 50) ** 2))(
        jnp.asarray(2.0)
    )
    assert slope < 0


def test_a_huge_concentration_is_a_normal():
    angle, kappa = jnp.asarray(2e-4), jnp.asarray(2e6)
    np.testing.assert_allclose(von_mises.concentration_slope(angle, kappa), -angle / (2 * kappa))
    below = von_mises.concentration_slope(jnp.asarray(1.5e-3), jnp.asarray(9e5))
    assert float(below) == pytest.approx(-1.5e-3 / (2 * 9e5), rel=1e-3)
