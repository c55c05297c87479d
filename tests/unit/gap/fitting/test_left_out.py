"""Clusters that a fit leaves out tell it nothing, not even by the unknowns that they have for themselves."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.fit import _guarded, fit
from dtprob.gap.fitting.marginal import own_mode
from dtprob.gap.model.problem import Problem

READINGS = 5


def hierarchy(y=None, links=24):
    mean = numpyro.sample("mean", dist.Normal(0.0, 10.0))
    with numpyro.plate("link", links):
        level = numpyro.sample("level", dist.Normal(mean, 1.5))
    with numpyro.plate("link", links, dim=-2), numpyro.plate("reading", READINGS, dim=-1):
        expected = numpyro.deterministic("expected", level[:, None] + jnp.zeros((links, READINGS)))
        numpyro.sample("y", dist.Normal(expected, 1.0), obs=y)


FADE = Effect(
    "fade",
    {"expected": lambda value, p, context: value + p["scale"] * p[FIELD]},
    (Parameter("scale", dist.HalfNormal(2.0)),),
    kind="variance",
    field_shape=lambda value, context: (value.shape[0], READINGS),
)
RNG = np.random.default_rng(0)
Y = RNG.normal(size=(24, 1)) + RNG.normal(size=(24, READINGS)) * 1.5
Y[18:] += 30.0
KEPT = np.arange(24) < 18


def shared(y, weights=None, effects=()):
    links = len(y)
    problem = Problem(hierarchy, {"y": jnp.asarray(y), "links": links}, [FADE]).with_live(effects)
    found = fit(problem, np.zeros(problem.dimension), effects, weights=weights, tolerance=1e-9)
    return problem, found


@pytest.mark.study
def test_levels_of_clusters_that_are_left_out_do_not_move_what_is_shared():
    _, alone = shared(Y[KEPT])
    problem, found = shared(Y, KEPT.astype(float))
    assert found.converged
    np.testing.assert_allclose(found.x[found.global_index], alone.x[alone.global_index], atol=1e-6)
    np.testing.assert_allclose(found.log_evidence, alone.log_evidence, atol=1e-6)
    levels = found.x[problem.layout["level"].index[18:, 0]]
    assert (levels > 15.0).all()  # their own data tell them


def test_fields_of_clusters_that_are_left_out_do_not_count():
    _, alone = shared(Y[KEPT], effects=("fade",))
    _, found = shared(Y, KEPT.astype(float), effects=("fade",))
    np.testing.assert_allclose(found.x[found.global_index], alone.x[alone.global_index], atol=1e-3)
    np.testing.assert_allclose(found.spread["fade"], alone.spread["fade"], rtol=1e-3)
    np.testing.assert_allclose(found.log_evidence, alone.log_evidence, atol=0.05)


def test_each_cluster_finds_its_own_mode_at_its_own_pace():
    """Counts whose levels are far from where they start: some need more damping than others."""

    def counts(y=None):
        with numpyro.plate("link", 200):
            level = numpyro.sample("level", dist.Normal(0.0, 2.0))
        with numpyro.plate("link", 200, dim=-2), numpyro.plate("reading", 3, dim=-1):
            numpyro.sample("y", dist.Poisson(jnp.exp(level[:, None] + jnp.zeros((200, 3)))), obs=y)

    rng = np.random.default_rng(3)
    y = rng.poisson(np.exp(2.0 * rng.normal(size=(200, 1)) + np.zeros((200, 3))))
    problem = Problem(counts, {"y": jnp.asarray(y)}, [])
    x, _ = own_mode(problem, activate(problem), np.zeros(problem.dimension))
    level = x[problem.layout["level"].index[:, 0]]
    slope = y.sum(axis=1) - 3 * np.exp(level) - level / 4.0
    assert np.abs(slope / np.sqrt(3 * np.exp(level) + 0.25)).max() < 0.1


def test_no_step_leads_a_cluster_that_is_left_out_astray():
    """Nothing else judges it: levels went where the likelihood was no number."""
    problem, found = shared(Y, KEPT.astype(float))
    active = activate(problem, weights=KEPT.astype(float))
    level = problem.layout["level"].index[:, 0]
    after = found.x.copy()
    after[level] += 1.0
    after[level[-1]] = np.inf
    kept = _guarded(problem, active, found.x, after)
    np.testing.assert_array_equal(kept[level[:18]], after[level[:18]])
    np.testing.assert_array_equal(kept[level[18:]], found.x[level[18:]])
