"""Sites that are computed from what was observed are no scale along which another site may vary."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects import Effect, Parameter
from dtprob.gap.diagnose import diagnose
from dtprob.gap.model.conditioned import conditioned
from dtprob.gap.model.problem import Problem
from dtprob.inference.laplace import Laplace

CELLS, ROWS = 20, 300


def link(cell, distance, rsrp, lost):
    """The power of a link, the rate that goes with the power that was read, packets lost, and filters of the power."""
    offset = numpyro.sample("offset", dist.Normal(-70.0, 10.0))
    rate = numpyro.sample("rate", dist.Normal(0.0, 1.0))
    noise = numpyro.sample("noise", dist.HalfNormal(5.0))
    with numpyro.plate("cells", CELLS):
        level = numpyro.sample("level", dist.Normal(0.0, 3.0))
    power = numpyro.deterministic("power", offset - 20 * jnp.log10(distance) + level[cell])
    numpyro.deterministic("before", 0.5 * jnp.concatenate([jnp.zeros(1), rsrp[:-1]]))
    numpyro.deterministic("after", 0.5 * jnp.concatenate([rsrp[1:], jnp.zeros(1)]))
    numpyro.deterministic("mean_power", jnp.mean(rsrp)[None])
    numpyro.deterministic("since", jnp.cumsum(lost) * 0.1 + 0.0 * rate)
    with numpyro.plate("row", len(distance)):
        numpyro.sample("rsrp", dist.Normal(power, noise), obs=rsrp)
        chance = numpyro.deterministic("chance", rate - 0.1 * (rsrp + 120))
        numpyro.sample("lost", dist.Bernoulli(logits=chance), obs=lost)


@pytest.fixture
def data():
    rng = np.random.default_rng(4)
    cell, distance = rng.integers(0, CELLS, ROWS), rng.uniform(1.0, 20.0, ROWS)
    rsrp = -70 - 20 * np.log10(distance) + 3 * rng.normal(size=CELLS)[cell] + 4 * rng.normal(size=ROWS)
    lost = (rng.random(ROWS) < 1 / (1 + np.exp(-1.0 + 0.1 * (rsrp + 120)))).astype(int)
    return {"cell": cell, "distance": distance, "rsrp": rsrp, "lost": lost}


def test_what_an_entry_of_the_data_moves_at_its_own_place_or_before(data):
    problem = Problem(link, data, [], "cell")
    assert conditioned(problem, problem.null()) == {"chance", "after", "mean_power", "since"}


@pytest.mark.study
def test_a_second_output_that_follows_from_the_first_is_no_gap(data):
    rewrite = {"power": lambda value, p, context: value + p["size"] * context["distance"]}
    effect = Effect("slope", rewrite, (Parameter("size", dist.Normal(0.0, 1.0)),), requires=("distance",))
    found = diagnose(link, data, [effect], cluster="cell", engine=Laplace(), key=jax.random.key(0))
    assert found.verdict == "NO_GAP"
