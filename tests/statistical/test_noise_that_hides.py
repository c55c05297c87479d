"""A wrong law of values in one group is not named for the noise that hides it, and noise is named where it is noise."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

import dtprob
from dtprob.effects import Effect, Parameter

READINGS = 180


def receivers(predicted, receiver, level=None):
    """Levels as predicted, off by one constant; their noise is known."""
    del receiver
    bias = numpyro.sample("bias", dist.Normal(0.0, 3.0))
    with numpyro.plate("reading", len(predicted)):
        mean = numpyro.deterministic("mean", predicted + bias)
        deviation = numpyro.deterministic("deviation", jnp.ones(len(predicted)))
        numpyro.sample("level", dist.Normal(mean, deviation), obs=level)


NOISE = Effect(
    "noise",
    {"deviation": lambda value, p, data: value * jnp.exp(p["log_ratio"] * (data["receiver"] == 2))},
    (Parameter("log_ratio", dist.Normal(0.0, 1.0)),),
    requires=("receiver",),
)
OFFSET = Effect(
    "offset",
    {"mean": lambda value, p, data: value + p["offset"] * (data["receiver"] == 2)},
    (Parameter("offset", dist.Normal(0.0, 5.0)),),
    requires=("receiver",),
)


@pytest.mark.parametrize(
    ("what", "verdict"),
    [
        ("mirrored", "UNLISTED"),
        pytest.param("noisy", "LISTED", marks=pytest.mark.study),
    ],
)
def test_noise_is_named_only_where_it_hides_nothing(what, verdict):
    """A receiver that counts its levels from the other end is off by up to 60, as noise of 37 deviations would have it."""
    rng = np.random.default_rng(0)
    predicted, receiver = rng.uniform(2.0, 60.0, READINGS), np.arange(READINGS) % 3
    wrong = 62.0 - predicted if what == "mirrored" else predicted + 37.0 * rng.normal(size=READINGS)
    level = np.where(receiver == 2, wrong, predicted) + rng.normal(size=READINGS)
    data = {
        name: jnp.asarray(v)
        for name, v in zip(("predicted", "receiver", "level"), (predicted, receiver, level), strict=True)
    }
    found = dtprob.diagnose(receivers, data, [NOISE, OFFSET], key=jax.random.key(0))
    assert found.verdict == verdict
    if what == "mirrored":
        first = found.to_report()["unlisted"]["located"][0]
        assert (first["site"], first["place"]) == ("mean", "receiver 2")
        assert "mean (along predicted by receiver)" in found.summary
    else:
        assert found.causes[0].effects == ("noise",)
