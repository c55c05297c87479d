"""A curve of unknown amplitude that all days share, beside levels of the days' own: both are integrated out."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects import Effect, Parameter
from dtprob.gap.fitting.bootstrap import _site_gradients, observed_rows
from dtprob.gap.fitting.integrated import based
from dtprob.gap.fitting.projection import project
from dtprob.gap.fitting.states import states
from dtprob.gap.model.problem import Problem
from dtprob.models.declaration import model

DAYS, HOURS, WAVES = 24, 12, 8
WEEKEND = np.arange(DAYS) % 7 >= 5
CURVES = np.cos(np.pi * np.outer(np.arange(1, WAVES + 1), np.arange(HOURS) + 0.5) / HOURS)


@model(cluster="day", axes={"load": ("day", "hour"), "expected": ("day", "hour")})
def days(weekend, load=None):
    level = numpyro.sample("level", dist.Normal(0.0, 5.0))
    amplitude = numpyro.sample("amplitude", dist.LogNormal(0.0, 1.0))
    spread = numpyro.sample("spread", dist.LogNormal(-1.0, 1.0))
    noise = numpyro.sample("noise", dist.LogNormal(-1.0, 1.0))
    with numpyro.plate("wave", WAVES):
        weight = numpyro.sample("weight", dist.Normal(0.0, 1.0))
    with numpyro.plate("days", len(weekend)):
        own = numpyro.sample("own", dist.Normal(0.0, 1.0))
    expected = numpyro.deterministic("expected", level + amplitude * weight @ CURVES + spread * own[:, None])
    with numpyro.plate("day", len(weekend), dim=-2), numpyro.plate("hour", HOURS, dim=-1):
        numpyro.sample("load", dist.Normal(expected, noise), obs=load)


EFFECT = Effect(
    "weekend",
    {"expected": lambda value, p, context: value + p["by"] * context["weekend"][:, None]},
    (Parameter("by", dist.Normal(0.0, 1.0)),),
)


@pytest.fixture(scope="module")
def fitted():
    rng = np.random.default_rng(3)
    levels = 0.4 * rng.normal(size=(DAYS, 1)) - 0.9 * WEEKEND[:, None]
    load = 1.0 + rng.normal(size=WAVES) @ CURVES + levels + 0.3 * rng.normal(size=(DAYS, HOURS))
    problem = Problem(days, {"weekend": WEEKEND.astype(float), "load": load}, [EFFECT])
    start = based(problem, jax.random.key(0))
    assert {b.name for b in states(start.problem).blocks} >= {"weight"}
    return start.problem, start.fitted, load


def generalised(sites, load):
    """The statistic of generalised least squares at the fitted spreads."""
    amplitude, spread, noise = (float(sites[n]) for n in ("amplitude", "spread", "noise"))
    each = np.repeat(np.arange(DAYS), HOURS)
    curves = np.tile(CURVES, DAYS)
    covariance = noise**2 * np.eye(DAYS * HOURS) + amplitude**2 * curves.T @ curves
    covariance += spread**2 * (each[:, None] == each)
    columns = np.stack([np.ones(DAYS * HOURS), WEEKEND[each]], axis=1)
    solved = np.linalg.solve(covariance, columns)
    information = columns.T @ solved + np.diag([1 / 25, 0.0])
    inverse = np.linalg.inv(information)
    return float((inverse @ (solved.T @ load.reshape(-1)))[1] / np.sqrt(inverse[1, 1]))


def test_what_acts_as_levels_do_is_told_as_by_generalised_least_squares(fitted):
    problem, fit, load = fitted
    projection = project(problem, fit)
    moved = np.broadcast_to(WEEKEND[:, None] * 1.0, (1, DAYS, HOURS))
    shift = np.asarray(problem.compiled.site_shift(fit.x, {"expected": jnp.asarray(moved)}))
    rows = projection.rows(projection.before_fit(np.asarray(problem.compiled.residual(fit.x))))
    z = float((rows * shift[..., 0]).sum() / np.sqrt(projection.information(shift)[0][0, 0]))
    exact = generalised(problem.compiled.sites(fit.x), load)
    assert exact < -3
    assert abs(z / exact - 1) < 0.1


def network(east, north, expected=None):
    """A surface by a small network, whose weights multiply one another: at zero the data say nothing of any."""
    with numpyro.plate("hidden", 4):
        inner = numpyro.sample("inner", dist.Normal(0.0, 1.0).expand([3]).to_event(1))
        outer = numpyro.sample("outer", dist.Normal(0.0, 1.0))
    noise = numpyro.sample("noise", dist.LogNormal(-1.0, 0.5))
    features = jnp.stack([east, north, jnp.ones_like(east)], -1)
    rate = numpyro.deterministic("rate", jnp.tanh(features @ inner.T) @ outer)
    with numpyro.plate("reading", len(east)):
        numpyro.sample("expected", dist.Normal(rate, noise), obs=expected)


def test_scores_stay_at_the_fit_where_nothing_depends_on_states_at_their_centre():
    """Taken at the centre they were made of rows a thousand times too large, and every effect was lost in these."""
    rng = np.random.default_rng(5)
    east, north = rng.uniform(-1, 1, (2, 400))
    some = rng.uniform(size=400) < 0.2
    seen = np.tanh(2 * east - north) - 0.5 * some + 0.3 * rng.normal(size=400)
    problem = Problem(network, {"east": east, "north": north, "expected": seen}, [])
    start = based(problem, jax.random.key(0))
    problem, fit = start.problem, start.fitted
    assert {b.name for b in states(problem).blocks} == {"inner", "outer"}
    projection = project(problem, fit)
    rows = observed_rows(problem, fit, projection)[1][None]
    centred = np.asarray(_site_gradients(problem, fit, projection, rows)["rate"][0])
    at_the_fit = np.asarray(problem.compiled.site_gradient(fit.x, rows)["rate"][0])
    assert at_the_fit[some].sum() < -50
    assert abs(centred[some].sum() / at_the_fit[some].sum() - 1) < 0.1
