"""Where the parts of a mixture come more or less often than the model says is seen, and nothing where they do not."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.gap.diagnose import diagnose
from dtprob.gap.settings import Settings
from dtprob.inference.laplace import Laplace
from dtprob.models.declaration import model
from dtprob.report.names import located_words

COUNT = 600


@model(axes={"blocked_loss": ("row",)}, cluster="route")
def sight(route, distance, loss=None):
    """Excess loss in line of sight, or behind an obstacle, as often everywhere."""
    del route
    chance = numpyro.sample("chance", dist.Beta(2.0, 2.0))
    extra = numpyro.sample("extra", dist.Normal(20.0, 5.0))
    spread = numpyro.sample("spread", dist.LogNormal(1.0, 0.5))
    blocked = numpyro.deterministic("blocked_loss", extra + 0.0 * distance)
    weights = jnp.broadcast_to(jnp.stack([chance, 1 - chance]), (len(distance), 2))
    means = jnp.stack([0.0 * distance, blocked], axis=-1)
    with numpyro.plate("row", len(distance)):
        numpyro.sample(
            "loss", dist.MixtureSameFamily(dist.Categorical(weights), dist.Normal(means, spread)), obs=loss
        )


@pytest.mark.study
@pytest.mark.parametrize("slope", [0.0, 6.0])
def test_how_often_parts_come_is_looked_at(slope):
    """A chance that falls with the distance was NO_GAP at 100 nats: no site that the model names tells of it."""
    rng = np.random.default_rng(0)
    route, distance = np.repeat(np.arange(40), COUNT // 40), rng.uniform(0.0, 1.0, COUNT)
    is_free = rng.random(COUNT) < 1 / (1 + np.exp(slope * (distance - 0.5)))
    loss = np.where(is_free, 0.0, 20.0) + 3.0 * rng.normal(size=COUNT)
    data = {"route": jnp.asarray(route), "distance": jnp.asarray(distance), "loss": jnp.asarray(loss)}
    settings = Settings(replicates=100)
    found = diagnose(
        sight, data, [], key=jax.random.key(0), engine=Laplace(), settings=settings, cluster="route"
    )
    assert found.verdict == ("UNLISTED" if slope else "NO_GAP")
    first = found.sections["where"]["sites"][0]
    assert not slope or located_words(first) == "shape of the loss"
    assert not slope or first["p_value"] < 1e-10
