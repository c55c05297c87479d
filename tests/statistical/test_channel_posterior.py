"""The posterior of a ray-traced channel's materials and noise is the same by either sampler."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from arviz_stats.base import array_stats
from scipy import stats

from dtprob.inference import LATENTS_ONLY, NUTS, BlackJAXNUTS
from dtprob.models.channel import ray_traced_channel
from tests import small_world

RATE = 1e-3
TRUTH = {
    "material_permittivity": jnp.asarray([4.6, 4.2]),
    "material_conductivity": jnp.asarray([0.08, 0.015]),
    "noise_level": jnp.asarray(1.1),
}


def measured():
    """Three links, two receive antennas and nine subcarriers over 40 MHz, at about 25 dB."""
    data = {
        "paths": small_world.trace(),
        "subcarrier_frequency": 5.0e6 * (jnp.arange(9) - 4.0),
        "rx_array": jnp.asarray([[0.0, -0.025, 0.0], [0.0, 0.025, 0.0]]),
        "noise_power": 1e-8,
    }
    fixed = numpyro.handlers.substitute(ray_traced_channel, data=TRUTH)
    trace = numpyro.handlers.trace(numpyro.handlers.seed(fixed, jax.random.key(2))).get_trace(**data)
    return {**data, "channel": trace["channel"]["value"]}


def entries(posterior):
    """Draws of each scalar, (chain, draw), by name."""
    return {
        f"{name}[{index}]": draws.reshape(*draws.shape[:2], -1)[..., index]
        for name, draws in posterior.draws.items()
        for index in range(int(np.prod(draws.shape[2:], dtype=int)))
    }


def estimates(draws):
    """Mean and standard deviation, each with its Monte-Carlo standard error."""
    errors = (array_stats.mcse(draws, chain_axis=0, draw_axis=1, method=m) for m in ("mean", "sd"))
    return list(zip((draws.mean(), draws.std()), map(float, errors), strict=True))


@pytest.mark.study
def test_two_samplers_agree_on_materials_and_noise():
    """z-scores of means and standard deviations; two-sided, all together at the declared failure rate.

    Chains start at the truth: walls of finite thickness reflect alike at several permittivities, modes between which
    no sampler moves.
    """
    data = measured()
    first, second = (
        entries(
            engine(draws=800, warmup=400, chains=4, initial=TRUTH)(
                key, ray_traced_channel, data, options=LATENTS_ONLY
            )
        )
        for engine, key in ((NUTS, jax.random.key(3)), (BlackJAXNUTS, jax.random.key(4)))
    )
    assert len(first) == 5
    limit = stats.norm.isf(RATE / 2 / (2 * len(first)))
    for name, draws in first.items():
        pairs = zip(("mean", "sd"), estimates(draws), estimates(second[name]), strict=True)
        for what, (one, one_error), (other, other_error) in pairs:
            z = (one - other) / np.hypot(one_error, other_error)
            print(f"{name} {what}: {one:.5g} +- {one_error:.2g}, {other:.5g} +- {other_error:.2g}, z {z:.2f}")
            assert abs(z) < limit, f"{what} of {name}"
            # Tight enough that a sampler wrong by a fifth of a standard deviation would show.
            assert np.hypot(one_error, other_error) * limit < 0.25 * draws.std(), f"{what} of {name}"
