"""Observations of many kinds are diagnosed: counts of packets, fading powers, phases, shadowing that neighbours share."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import Effect, Parameter
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.inference import Laplace

STREETS, PLACES, PACKETS = 30, 10, 40
SETTINGS = Settings(replicates=200, site_replicates=39, candidates=3, max_effects=2)
APART = np.abs(np.subtract.outer(np.arange(PLACES), np.arange(PLACES)))
ROOT = jnp.asarray(np.linalg.cholesky(np.exp(-APART / 3.0)))


def received(level):
    """Packets received of those sent; the level is the margin in dB."""
    return dist.Binomial(PACKETS, logits=0.4 * level).to_event(1)


def faded(level):
    """Mean power over four independent Rayleigh fades, in units of 10^(level / 10)."""
    return dist.Gamma(4.0, 4.0 * jnp.exp(-0.23 * level)).to_event(1)


def shadowed(level):
    """dB, errors that neighbouring places of a street share."""
    deviation = numpyro.sample("deviation", dist.LogNormal(0.0, 1.0))
    return dist.MultivariateNormal(level, scale_tril=deviation * ROOT)


def bursty(level):
    """Packets that come in bursts, 20 times 10^(level / 10) on average."""
    concentration = numpyro.sample("concentration", dist.LogNormal(1.0, 1.0))
    return dist.NegativeBinomial2(jnp.exp(0.23 * level + 3.0), concentration).to_event(1)


def turned(level):
    """A phase in radians that turns by .4 for each unit."""
    return dist.VonMises(0.4 * level, 2.0).to_event(1)


OBSERVED = {"received": received, "faded": faded, "shadowed": shadowed, "bursty": bursty, "turned": turned}


def streets(kind):
    def model(distance, blocked, y=None):
        slope = numpyro.sample("slope", dist.Normal(1.0, 1.0))
        offset = numpyro.sample("offset", dist.Normal(0.0, 5.0))
        level = numpyro.deterministic("level", offset - slope * distance)
        observed = OBSERVED[kind](level)
        with numpyro.plate("street", distance.shape[0]):
            numpyro.sample("y", observed, obs=y)

    return model


EFFECTS = (
    Effect(
        "wall",
        {"level": lambda level, p, context: level - p["loss"] * context["blocked"]},
        (Parameter("loss", dist.Normal(0.0, 3.0), unit="dB"),),
        physics="Some places lie behind a wall.",
        source="A constant loss.",
        requires=("blocked",),
    ),
    Effect(
        "second_slope",
        {"level": lambda level, p, context: level - p["more"] * jnp.maximum(context["distance"], 0.0)},
        (Parameter("more", dist.Normal(0.0, 1.0), unit="dB"),),
        physics="The level falls faster far away.",
        source="Two slopes.",
        requires=("distance",),
    ),
)


def table(kind, loss, seed):
    """A survey by NumPy alone."""
    rng = np.random.default_rng(seed)
    distance = rng.uniform(-2, 2, (STREETS, PLACES))
    blocked = (rng.uniform(size=(STREETS, PLACES)) < 0.3).astype(float)
    level = 1.0 - 1.2 * distance - loss * blocked
    match kind:
        case "received":
            y = rng.binomial(PACKETS, 1 / (1 + np.exp(-0.4 * level)))
        case "faded":
            y = rng.gamma(4.0, np.exp(0.23 * level) / 4.0)
        case "bursty":
            y = rng.poisson(rng.gamma(5.0, np.exp(0.23 * level + 3.0) / 5.0))
        case "turned":
            y = rng.vonmises(0.4 * level, 2.0)
        case _:
            y = level + 1.5 * rng.standard_normal((STREETS, PLACES)) @ np.asarray(ROOT).T
    return {"distance": jnp.asarray(distance), "blocked": jnp.asarray(blocked), "y": jnp.asarray(y)}


def found(kind, loss, seed):
    data = table(kind, loss, seed)
    return diagnose(
        streets(kind), data, EFFECTS, key=jax.random.key(2), engine=Laplace(draws=400), settings=SETTINGS
    )


@pytest.mark.parametrize("kind", OBSERVED)
def test_a_wall_is_named_and_its_loss_is_right(kind):
    said = found(kind, 2.0, seed=6)
    assert said.verdict == "LISTED"
    cause = said.causes[0]
    assert cause.effects == ("wall",)
    size = cause.size[0]
    deviation = (size.high - size.low) / 3.29
    assert deviation < 0.35
    assert abs(size.mean - 2.0) < 3 * deviation
    assert cause.closed_fraction.mean > 0.9


@pytest.mark.parametrize("kind", OBSERVED)
def test_nothing_is_named_where_nothing_is_wrong(kind):
    assert found(kind, 0.0, seed=5).verdict == "NO_GAP"


def test_a_vector_is_not_torn_into_clusters():
    """Without a plate the entries of one vector would be taken as independent."""

    def model(distance, y=None):
        level = numpyro.deterministic("level", numpyro.sample("offset", dist.Normal(0.0, 5.0)) - distance)
        numpyro.sample("y", dist.MultivariateNormal(level, scale_tril=ROOT), obs=y)

    data = {"distance": jnp.linspace(0.0, 1.0, PLACES), "y": jnp.zeros(PLACES)}
    with pytest.raises(InputError, match="whole vectors of 'y' in each"):
        Problem(model, data, EFFECTS[1:])
