"""The repair of the complex square root."""

import numpy as np
import pytest
from scipy.constants import epsilon_0

from dtprob.raytracing.sionna_patch import repaired_sionna

pytestmark = pytest.mark.libllvm


def reflected(permittivity, conductivity, cosine=0.6, frequency=3.5e9):
    """What sionna-rt takes a wall to reflect, r_te, at many conductivities, and its derivative."""
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.utils import electromagnetics

    sigma = mi.Float(conductivity)
    dr.enable_grad(sigma)
    eta = electromagnetics.complex_relative_permittivity(mi.Float(permittivity), sigma, 2 * np.pi * frequency)
    r_te, _ = electromagnetics.fresnel_reflection_coefficients_simplified(mi.Float(cosine), eta)
    value = np.asarray(r_te.real) + 1j * np.asarray(r_te.imag)
    dr.backward(dr.sum(r_te.imag))
    return value, np.asarray(dr.grad(sigma))


def exact(permittivity, conductivity, cosine=0.6, frequency=3.5e9):
    def value(sigma):
        root = np.sqrt(permittivity - 1j * sigma / (2 * np.pi * frequency * epsilon_0) - (1 - cosine**2))
        return (cosine - root) / (cosine + root)

    step = 1e-6
    return value(conductivity), (value(conductivity + step) - value(conductivity - step)).imag / (2 * step)


def test_conductivity_of_low_loss_materials_counts(rt):
    sigma = np.array([2e-4, 1e-3, 1e-2, 1e-1, 1.0, 1e7])
    value, slope = exact(4.0, sigma)
    stock = reflected(4.0, sigma)
    with repaired_sionna():
        repaired = reflected(4.0, sigma)
    assert np.allclose(repaired[0], value, rtol=1e-6, atol=1e-6)
    assert np.allclose(repaired[1][:5], slope[:5], rtol=1e-4)
    assert np.max(np.abs(stock[1] / slope - 1)[:2]) > 0.02  # the defect is there: without it, drop the repair
    after = reflected(4.0, sigma)
    assert np.array_equal(after[0], stock[0])


def test_derivative_at_no_loss(rt):
    _, slope = exact(4.0, np.array([0.0]))
    with repaired_sionna():
        _, found = reflected(4.0, np.array([0.0]))
    assert found == pytest.approx(slope, rel=1e-4)


def test_the_root_squares_back(rt):
    import mitsuba as mi

    from dtprob.raytracing.sionna_patch import stable_square_root

    random = np.random.default_rng(0)
    real, imaginary = random.normal(size=(2, 1000)) * 10.0 ** random.uniform(-3, 3, (2, 1000))
    root = stable_square_root(mi.Complex2f(mi.Float(real), mi.Float(imaginary)))
    found = np.asarray(root.real, np.float64) + 1j * np.asarray(root.imag, np.float64)
    expected = np.sqrt(np.float32(real) + 1j * np.float32(imaginary))
    assert np.max(np.abs(found - expected) / np.abs(expected)) < 1e-6
