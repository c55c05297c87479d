"""Expected losses of clusters: in closed form, of noise and observations that differ between them."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.gap.how_far.expected import expected_loss
from dtprob.gap.model.problem import Problem

NOISE = np.geomspace(0.1, 10.0, 5)
N_SAMPLE = 200


def mixed(x, noise, seen, y=None, hit=None):
    """Readings whose noise is each link's own, some masked, and one outcome."""
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    with numpyro.plate("link", len(noise), dim=-2):
        with numpyro.plate("sample", N_SAMPLE, dim=-1):
            numpyro.sample("y", dist.Normal(slope * x, noise[:, None]).mask(seen), obs=y)
        with numpyro.plate("trial", 1, dim=-1):
            numpyro.sample("hit", dist.Bernoulli(probs=0.5 * jnp.ones((len(noise), 1))), obs=hit)


def test_it_is_the_entropy_of_what_each_cluster_shows():
    rng = np.random.default_rng(0)
    x, seen = rng.normal(size=(5, N_SAMPLE)), rng.random((5, N_SAMPLE)) < 0.5
    y, hit = x + NOISE[:, None] * rng.normal(size=x.shape), np.ones((5, 1))
    given = {"x": x, "noise": NOISE, "seen": seen, "y": y, "hit": hit}
    problem = Problem(mixed, {n: jnp.asarray(v) for n, v in given.items()}, (), "link")
    found = expected_loss(problem, problem.start({"b": 1.0}))
    count = seen.sum(1)
    expected = count * 0.5 * np.log(2 * np.pi * np.e * NOISE**2) + np.log(2.0)
    assert found == pytest.approx(expected, abs=4 * np.sqrt(0.5 * count.max() / 64))
    np.testing.assert_allclose(problem.n_observation_of_each, count + 1)
