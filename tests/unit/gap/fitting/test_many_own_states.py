"""Clusters with a state of their own for every reading, more of them than 128, whose counts bend as the states move."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.gap.fitting import projection as projections
from dtprob.gap.fitting.bootstrap import replicate
from dtprob.gap.fitting.integrated import based
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.where.locate import locate

CELLS, HOURS = 4, 136
CYCLE = np.cos(2 * np.pi * np.arange(HOURS) / 24)
SETTINGS = Settings(replicates=99, site_times=1)


def cells(cycle, count=None):
    """Counts of cells whose log rates wander about a day's cycle, each by itself."""
    spread = numpyro.sample("spread", dist.LogNormal(-1.5, 0.5))
    mean = numpyro.sample("mean", dist.Normal(2.0, 1.0))
    swing = numpyro.sample("swing", dist.Normal(0.0, 1.0))
    with numpyro.plate("cells", CELLS):
        wander = numpyro.sample("wander", dist.Normal(0.0, 1.0).expand([HOURS]).to_event(1))
    state = jax.lax.scan(lambda s, e: (0.8 * s + spread * e,) * 2, jnp.zeros(CELLS), wander.T)[1].T
    log_rate = numpyro.deterministic("log_rate", mean + swing * cycle + state)
    with numpyro.plate("cell", CELLS, dim=-2), numpyro.plate("hour", HOURS, dim=-1):
        numpyro.sample("count", dist.Poisson(jnp.exp(log_rate)), obs=count)


@pytest.fixture(scope="module")
def fitted():
    rng = np.random.default_rng(3)
    state, log_rate = np.zeros(CELLS), np.empty((CELLS, HOURS))
    for hour in range(HOURS):
        state = 0.8 * state + 0.2 * rng.normal(size=CELLS)
        log_rate[:, hour] = 2.2 + 0.4 * CYCLE[hour] + state
    problem = Problem(cells, {"cycle": CYCLE, "count": rng.poisson(np.exp(log_rate))}, [])
    start = based(problem, jax.random.key(0))
    return start.problem, start.fitted


@pytest.mark.parametrize("most", [projections.MOST, 128])
def test_a_right_twin_has_no_gap_along_its_own_cycle(fitted, monkeypatch, most):
    """Columns of the cycle at the states' centre beside scores at the fit made a gap of p 1e-100 along it."""
    monkeypatch.setattr(projections, "MOST", most)
    problem, fit = fitted
    projection = project(problem, fit)
    assert (projection.centre is None) == (most < HOURS)
    drawn = replicate(problem, fit, projection, jax.random.key(1), SETTINGS)
    assert locate(problem, fit, projection, drawn, SETTINGS).site_p_value > 0.01
