"""The mass of each mode of phases that the data cannot tell apart, against quadrature."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.inference import LATENTS_ONLY, SMC
from dtprob.models.complex_normal import ComplexNormal

RATE = 1e-3
RUNS = 8
GAIN = np.asarray([1.0, 0.8])
TONES = 6


def unresolved(noise, y=None):
    """Two paths of one delay: their phases may be mirrored about the direction of their sum."""
    with numpyro.plate("path", 2):
        phase = numpyro.sample("phase", dist.VonMises(jnp.asarray([0.0, 1.0]), 0.7))
    with numpyro.plate("tone", TONES):
        numpyro.sample("y", ComplexNormal(jnp.sum(GAIN * jnp.exp(1j * phase)), noise), obs=y)


def shares_by_quadrature(y, noise):
    """Of the order in which the phases lie about the sum's direction; trapezoids, exact for periodic functions."""
    grid = 2 * np.pi * np.arange(2000) / 2000
    first, second = grid[:, None], grid[None]
    total = GAIN[0] * np.exp(1j * first) + GAIN[1] * np.exp(1j * second)
    log_density = 0.7 * (np.cos(first) + np.cos(second - 1)) - TONES * np.abs(total - y.mean()) ** 2 / noise
    weight = np.exp(log_density - log_density.max())
    return float(weight[np.sin(first - second) > 0].sum() / weight.sum())


@pytest.mark.study
@pytest.mark.parametrize("noise", [0.3, 3.0])  # two narrow modes far apart; one broad valley at low signal
def test_particles_are_shared_out_as_the_mass_is(noise):
    """Student's t over independent runs, two-sided at the declared rate; the modes are of unequal mass."""
    random = np.random.default_rng(5)
    clean = np.sum(GAIN * np.exp(1j * np.asarray([0.9, -0.4])))
    y = clean + np.sqrt(noise / 2) * (random.normal(size=TONES) + 1j * random.normal(size=TONES))
    share = shares_by_quadrature(y, noise)
    assert 0.02 < share < 0.4 or 0.6 < share < 0.98
    engine = SMC(draws=600, chains=RUNS, moves=3, leapfrog=6)
    drawn = engine(jax.random.key(6), unresolved, {"noise": noise, "y": y}, options=LATENTS_ONLY).draws[
        "phase"
    ]
    found = np.mean(np.sin(drawn[..., 0] - drawn[..., 1]) > 0, axis=1)
    error = found.std(ddof=1) / RUNS**0.5
    print(f"noise {noise}: share {share:.4f} by quadrature, {found.mean():.4f} +- {error:.4f} by particles")
    assert abs(found.mean() - share) < stats.t.isf(RATE / 2, RUNS - 1) * error
    assert error < 0.03  # tight enough that an equal split would show
