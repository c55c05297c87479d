"""Data sets drawn at a fit: their noise knows nothing of what is drawn from the priors."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.gap.fitting.bootstrap import normal_like, replicate
from dtprob.gap.fitting.fit import fit
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.models.declaration import model

DEVICES, DRAWS = 12, 400


@model(axes={"power": ("device",), "ratio": ("device",)}, cluster="device")
def levels(height, power=None, ratio=None):
    """Two readings of each device, whose level is its own, and a state of each that all share."""
    slope = numpyro.sample("slope", dist.Normal(jnp.zeros(2), 1.0).to_event(1))
    with numpyro.plate("device", DEVICES):
        own = numpyro.sample("own", dist.Normal(0.0, 1.0))
        numpyro.sample(
            "heard", dist.Normal(numpyro.deterministic("power", own + slope[0] * height), 0.5), obs=power
        )
        numpyro.sample(
            "told", dist.Normal(numpyro.deterministic("ratio", own + slope[1] * height), 0.5), obs=ratio
        )


@pytest.fixture(scope="module")
def drawn():
    rng = np.random.default_rng(0)
    columns = {name: jnp.asarray(rng.normal(size=DEVICES)) for name in ("height", "power", "ratio")}
    problem = Problem(levels, columns, [])
    fitted = fit(problem, problem.null())
    settings = Settings(replicates=DRAWS, site_replicates=DRAWS)
    return replicate(problem, fitted, project(problem, fitted), jax.random.key(0), settings)


def noise_and_prior(drawn, draw):
    """Rows of noise and what the prior's draws add to them (replicate, row), as a draw hands them to a projection."""
    parts = []

    def with_prior(rows, keys):
        parts.append((np.asarray(rows), drawn.projection.with_prior(np.zeros(np.shape(rows)), keys)))
        return np.asarray(rows)

    spy = SimpleNamespace(with_prior=with_prior, rows=drawn.projection.rows)
    draw(SimpleNamespace(**{**vars(drawn), "projection": spy}))
    return (np.concatenate(part).reshape(-1, drawn.raw.size) for part in zip(*parts, strict=True))


def correlations(noise, prior):
    """Of each row of noise with each row that priors move."""
    prior = prior[:, prior.std(axis=0) > 0]
    assert prior.shape[1] == 2 * DEVICES
    return np.corrcoef(noise, prior, rowvar=False)[: noise.shape[1], noise.shape[1] :]


def test_noise_and_prior_draws_are_independent(drawn):
    """One key, split for the noise and folded for the prior, gave both the same numbers: every row its own level's."""
    portions = type(drawn).portions
    noise, prior = noise_and_prior(drawn, lambda spied: list(portions(spied)))
    assert np.abs(correlations(noise, prior)).max() < 5 / np.sqrt(DRAWS)


def test_normal_rows_and_prior_draws_are_independent(drawn):
    def draw(spied):
        spied.at_sites, spied.site_gradients = DRAWS, lambda rows: {}
        normal_like(spied)

    noise, prior = noise_and_prior(drawn, draw)
    assert np.abs(correlations(noise, prior)).max() < 5 / np.sqrt(DRAWS)
