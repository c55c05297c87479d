"""Coefficients of a wall."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.constants import epsilon_0

from dtprob.errors import InputError
from dtprob.raytracing.slab import coefficients, lossy_square_root

F = 3.5e9


def cases(n=4000, seed=0):
    """Angles, materials and thicknesses from air to metal."""
    random = np.random.default_rng(seed)
    cosine = np.r_[1.0, 1e-3, random.uniform(0, 1, n - 2)]
    return cosine, random.uniform(1, 12, n), 10 ** random.uniform(-5, 7, n), 10 ** random.uniform(-4, -0.3, n)


def found(cosine, permittivity, conductivity, thickness, *, law="slab", dtype=np.float64):
    arrays = (jnp.asarray(a, dtype) for a in (cosine, permittivity, conductivity, thickness))
    return [np.asarray(r) + 1j * np.asarray(i) for r, i in coefficients(*arrays, frequency=F, law=law)]


@pytest.mark.parametrize("law", ["slab", "half_space"])
def test_agrees_with_the_recommendation(oracles, law):
    values = cases()
    for mine, exact in zip(found(*values, law=law), oracles.slab(values[0], values[1:], F, law), strict=True):
        assert np.max(np.abs(mine - exact)) < 1e-9


def test_single_precision(oracles):
    cosine, permittivity, conductivity, _ = cases(seed=1)
    values = cosine, permittivity, conductivity, np.full_like(cosine, 0.1)
    rounded = [np.float32(a).astype(np.float64) for a in values]
    for mine, exact in zip(
        found(*values, dtype=np.float32), oracles.slab(rounded[0], rounded[1:], F), strict=True
    ):
        error = np.abs(mine - exact)
        assert np.all(np.isfinite(mine))
        assert np.quantile(error, 0.99) < 1e-5


def test_without_loss_all_power_comes_out():
    cosine, permittivity, _, thickness = cases(seed=2)
    r_te, r_tm, t_te, t_tm = found(cosine, permittivity, np.zeros_like(cosine), thickness)
    assert np.max(np.abs(np.abs(r_te) ** 2 + np.abs(t_te) ** 2 - 1)) < 1e-10
    assert np.max(np.abs(np.abs(r_tm) ** 2 + np.abs(t_tm) ** 2 - 1)) < 1e-10


def test_no_wall_and_a_thick_lossy_wall():
    cosine, permittivity, _, _ = cases(seed=3)
    r_te, r_tm, t_te, t_tm = found(cosine, permittivity, np.full_like(cosine, 0.1), np.zeros_like(cosine))
    assert np.max(np.abs([r_te, r_tm])) < 1e-10
    assert np.max(np.abs(np.array([t_te, t_tm])[:, cosine > 0.01] - 1)) < 1e-9
    thick = found(cosine, permittivity, np.full_like(cosine, 2.0), np.full_like(cosine, 1.0))
    half = found(cosine, permittivity, np.full_like(cosine, 2.0), np.full_like(cosine, 1.0), law="half_space")
    assert np.max(np.abs(np.array(thick[:2]) - half[:2])) < 1e-12


def test_polarisations_agree_at_normal_incidence():
    _, permittivity, conductivity, thickness = cases(seed=4)
    r_te, r_tm, t_te, t_tm = found(np.ones_like(permittivity), permittivity, conductivity, thickness)
    assert np.max(np.abs(r_te + r_tm)) < 1e-12
    assert np.max(np.abs(t_te - t_tm)) < 1e-12


@pytest.mark.parametrize("conductivity", [0.0, 1e-6, 2e-4, 1e-3, 1e-1])
def test_small_conductivity_survives_single_precision(conductivity):
    def reflected(sigma, dtype):
        value = [jnp.asarray(a, dtype) for a in (0.6, 4.0)]
        r = coefficients(*value, sigma, jnp.asarray(0.1, dtype), frequency=F, law="slab")
        return r.reflected_te[0] + r.reflected_te[1]

    exact = jax.grad(reflected)(jnp.asarray(conductivity, jnp.float64), np.float64)
    single = jax.grad(reflected)(jnp.asarray(conductivity, jnp.float32), np.float32)
    assert single == pytest.approx(float(exact), rel=2e-5)


@pytest.mark.parametrize("cosine", [1.0, 0.3, 1e-6, 0.0])
@pytest.mark.parametrize("permittivity", [1.0, 4.0])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gradients_are_finite_at_the_edges(cosine, permittivity, dtype):
    def total(values):
        return sum(jnp.sum(part) for pair in coefficients(*values, frequency=F, law="slab") for part in pair)

    values = [jnp.asarray(a, dtype) for a in (cosine, permittivity, 0.0, 0.1)]
    assert all(np.isfinite(g) for g in jax.grad(total)(values))


def test_square_root_decays_and_squares_back():
    random = np.random.default_rng(5)
    real, loss = random.normal(size=500) * 5, random.exponential(size=500)
    root = np.asarray(lossy_square_root(jnp.asarray(real), jnp.asarray(loss)))
    root = root[0] + 1j * root[1]
    assert np.all(root.imag <= 0)
    assert np.max(np.abs(root**2 - (real - 1j * loss))) < 1e-12


def test_conductivity_enters_by_the_frequency():
    eta = np.sqrt(4 - 1j * 0.02 / (2 * np.pi * F * epsilon_0))
    expected = (1 - eta) / (1 + eta)
    assert found(1.0, 4.0, 0.02, 0.1, law="half_space")[0] == pytest.approx(expected, rel=1e-12)


def test_unknown_law():
    with pytest.raises(InputError, match="slab"):
        coefficients(*map(jnp.asarray, (1.0, 4.0, 0.1, 0.1)), frequency=F, law="slabs")
