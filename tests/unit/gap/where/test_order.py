"""Of sites that a gap shows at alike, the one nearest to the data is named first, whatever rounding says."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.gap.diagnose import diagnose
from dtprob.gap.settings import Settings
from dtprob.gap.where.locate import SiteFinding, _shadows_last
from dtprob.inference import Laplace
from dtprob.models.declaration import model


@model(axes={"distance": ("segment", "sample"), "power": ("segment", "sample")}, cluster="segment")
def path_loss(length, seen=None):
    """A power law of a distance: a relative error of the one is an additive error of the other."""
    level = numpyro.sample("level", dist.Normal(0.0, 30.0))
    distance = numpyro.deterministic("distance", length)
    power = numpyro.deterministic("power", level - 30.0 * jnp.log10(distance))
    with numpyro.plate("segment", length.shape[0], dim=-2), numpyro.plate("sample", length.shape[1], dim=-1):
        numpyro.sample("reading", dist.Normal(power, 2.0), obs=seen)


@pytest.mark.parametrize("seed", range(2))
def test_a_site_that_acts_through_another_alone_comes_after_it(seed):
    rng = np.random.default_rng(seed)
    length = rng.uniform(10.0, 400.0, (20, 10))
    seen = -30.0 * np.log10(length) + 2.0 * np.sin(length / 20.0) + 2.0 * rng.normal(size=length.shape)
    settings = Settings(replicates=100, site_replicates=50)
    data = {"length": jnp.asarray(length), "seen": jnp.asarray(seen)}
    found = diagnose(path_loss, data, [], key=jax.random.key(seed), engine=Laplace(), settings=settings)
    assert found.verdict == "UNLISTED"
    assert found.sections["unlisted"]["sites"][:2] == ["power", "distance"]
    assert [one["site"] for one in found.sections["where"]["sites"][:2]] == ["power", "distance"]


@pytest.mark.parametrize(("of_spread", "first"), [(1e-3, "mean"), (1e-6, "mean"), (1e-12, "deviation")])
def test_a_site_that_only_spreads_comes_after_values_that_are_surely_wrong(of_spread, first):
    """By whatever name; unless it is more than twice as surely wrong."""
    mean = SiteFinding("mean", "additive, common", 1e-4, 20.0)
    deviation = SiteFinding("deviation", "relative, common", of_spread, 20.0, spreads=True)
    assert min(_shadows_last([deviation, mean]), key=lambda found: found.last).site == first
