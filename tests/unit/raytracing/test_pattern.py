"""Antenna elements."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.raytracing.pattern import PATTERNS, field_vector, rotation_matrix


def directions(n=400, seed=0):
    vectors = np.random.default_rng(seed).normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("polarization", ["V", "H", 0.4])
def test_fields_are_transverse(pattern, polarization):
    k = directions()
    field = field_vector(
        jnp.asarray(k), pattern=pattern, polarization=polarization, orientation=(0.3, -0.2, 1.0)
    )
    assert np.max(np.abs(np.sum(field * k, axis=-1))) < 1e-12


@pytest.mark.parametrize(
    ("pattern", "radiated"), [("iso", 1.0), ("dipole", 1.0), ("hw_dipole", 1.643 / 1.640922)]
)
def test_antennas_radiate_what_they_are_fed(pattern, radiated):
    z, weight = np.polynomial.legendre.leggauss(200)
    k = np.stack([np.sqrt(1 - z**2), np.zeros_like(z), z], axis=-1)
    gain = np.sum(np.square(field_vector(jnp.asarray(k), pattern=pattern)), axis=-1)
    assert weight @ gain / 2 == pytest.approx(radiated, rel=1e-5)  # Sionna rounds 1.640922 to 1.643


def test_rotation_carries_the_antenna_along():
    """Turning antenna and direction together turns the field with them."""
    k, angles = directions(), jnp.array([0.7, -0.4, 1.9])
    turn = rotation_matrix(angles)
    assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-14)
    still = field_vector(jnp.asarray(k), pattern="tr38901", polarization=0.5)
    turned = field_vector(jnp.asarray(k @ turn.T), pattern="tr38901", polarization=0.5, orientation=angles)
    assert np.allclose(turned, still @ turn.T, atol=1e-12)


def test_orientation_per_direction():
    k, angles = jnp.asarray(directions(5)), jnp.asarray(np.random.default_rng(1).normal(size=(5, 3)))
    together = field_vector(k, pattern="dipole", orientation=angles)
    apart = [field_vector(k[i], pattern="dipole", orientation=angles[i]) for i in range(5)]
    assert np.allclose(together, apart, atol=1e-14)


def test_gradient_is_finite_at_the_poles():
    def total(k, angles):
        return jnp.sum(field_vector(k, pattern="hw_dipole", polarization=0.3, orientation=angles))

    for pole in (1.0, -1.0):
        grads = jax.grad(total, argnums=(0, 1))(jnp.array([0.0, 0.0, pole]), jnp.zeros(3))
        assert all(np.all(np.isfinite(g)) for g in grads)


def test_unknown_names():
    k = jnp.array([[1.0, 0.0, 0.0]])
    with pytest.raises(InputError, match="Did you mean 'dipole'"):
        field_vector(k, pattern="dipol")
    with pytest.raises(InputError, match="polarization of a single element"):
        field_vector(k, polarization="VH")


@pytest.mark.libllvm
@pytest.mark.parametrize("pattern", PATTERNS)
def test_amplitudes_are_those_of_sionna(rt, pattern):
    import mitsuba as mi

    theta, phi = np.random.default_rng(2).uniform(0.1, [[np.pi - 0.1], [2 * np.pi]], (2, 300))
    phi -= np.pi
    array = rt.PlanarArray(num_rows=1, num_cols=1, pattern=pattern, polarization="V")
    theirs, _ = array.antenna_pattern.patterns[0](mi.Float(theta), mi.Float(phi))
    k = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    along = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)], axis=-1)
    mine = np.sum(np.asarray(field_vector(jnp.asarray(k), pattern=pattern)) * along, axis=-1)
    assert np.allclose(mine, np.asarray(theirs.real), rtol=2e-5, atol=1e-6)
