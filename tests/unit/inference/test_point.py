"""Point estimates are the textbook's: the mode over constrained values, or the likelihood's maximum."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.inference import Point
from tests.unit.inference.examples import normal, normal_data, normal_posterior

KEY = jax.random.key(12)
COUNTS = np.array([7, 2, 11])


def counts(concentration, total, y=None):
    chance = numpyro.sample("chance", dist.Dirichlet(concentration * jnp.ones(3)))
    numpyro.sample("y", dist.Multinomial(total, chance), obs=y)


def counts_data(concentration):
    return {"concentration": np.float64(concentration), "total": np.int64(20), "y": COUNTS}


@pytest.mark.parametrize("concentration", [pytest.param(1.01, marks=pytest.mark.study), 3.0])
def test_mode_of_a_dirichlet(concentration):
    posterior = Point()(KEY, counts, counts_data(concentration))
    expected = (COUNTS + concentration - 1) / (COUNTS + concentration - 1).sum()
    np.testing.assert_allclose(posterior.draws["chance"][0, 0], expected, atol=1e-6)
    assert posterior.draws["chance"].shape == (1, 1, 3)
    assert bool(posterior.extra["converged"])


def test_maximum_likelihood_of_counts():
    posterior = Point(objective="maximum_likelihood")(KEY, counts, counts_data(3.0))
    np.testing.assert_allclose(posterior.draws["chance"][0, 0], COUNTS / 20, atol=1e-6)


def test_normal():
    data = normal_data()
    assert Point()(KEY, normal, data).draws["level"].item() == pytest.approx(normal_posterior(data)[0])
    found = Point(objective="maximum_likelihood")(KEY, normal, data).draws["level"].item()
    assert found == pytest.approx(data["y"].mean())


def at_the_edge(y=None):
    size = numpyro.sample("size", dist.Exponential(1.0))
    numpyro.sample("y", dist.Normal(size, 1.0), obs=y)


def test_a_mode_on_the_edge_is_approached():
    posterior = Point()(KEY, at_the_edge, {"y": np.float64(-2.0)})
    assert 0 < posterior.draws["size"].item() < 1e-6
