"""What a projection makes of columns a few clusters at a time, and what priors of several coordinates together know."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.contrib.control_flow import scan

from dtprob.gap.fitting.fit import fit
from dtprob.gap.fitting.projection import Known, Projection, project
from dtprob.gap.model.problem import Problem
from dtprob.models.declaration import model


def _projection(n_global, n_local, *, clusters=70, rows=5):
    """A projection with random tangents and unit priors, so that it is no orthogonal one."""
    rng = np.random.default_rng(n_global + 10 * n_local)
    shared, own = rng.normal(size=(clusters, rows, n_global)), rng.normal(size=(clusters, rows, n_local))
    inverse = np.linalg.inv(np.swapaxes(own, 1, 2) @ own + np.eye(n_local))
    reduced = shared - own @ (inverse @ (np.swapaxes(own, 1, 2) @ shared))
    curvature = np.einsum("cmi,cmj->ij", shared, reduced) + np.eye(n_global)
    nothing = (
        Known(np.zeros(n_global), np.zeros((n_global, n_global))),
        Known(np.zeros((clusters, n_local)), np.zeros((clusters, n_local, n_local))),
    )
    arrays = (shared, own, inverse, np.linalg.inv(curvature), reduced)
    return Projection(*arrays, *nothing, np.zeros(n_global), None)


@pytest.mark.parametrize(("n_global", "n_local"), [(3, 2), (3, 0), (0, 2), (0, 0)])
def test_information_and_scores_are_those_of_projected_columns(n_global, n_local):
    projection, rng = _projection(n_global, n_local), np.random.default_rng(1)
    columns, rows = rng.normal(size=(70, 5, 4)), rng.normal(size=(6, 70, 5))
    adjusted, coefficients = projection.adjust(columns)
    information, found = projection.information(columns)
    np.testing.assert_allclose(information, np.einsum("cmi,cmj->ij", columns, adjusted), atol=1e-10)
    np.testing.assert_allclose(found, coefficients, atol=1e-12)
    score = np.einsum("cmk,rcm->rk", columns, projection.adjoint(rows))
    np.testing.assert_allclose(score, np.einsum("cmk,rcm->rk", adjusted, rows), atol=1e-10)


def test_a_prior_adds_the_same_numbers_whatever_they_are_drawn_with():
    projection = replace(_projection(3, 2), shared=Known(np.zeros(3), 2.0 * np.eye(3)))
    keys = jax.random.split(jax.random.key(0), 6)
    drawn = jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, 0), (3,)))(keys)
    rows = projection.with_prior(np.zeros((6, 70, 5)), keys)
    np.testing.assert_allclose(rows, np.einsum("cmg,rg->rcm", projection.columns, 2 * drawn), atol=1e-12)


STEPS, USERS, READINGS = 6, 40, 2
RHO, NOISE = 0.9, 0.5


def walks(x, y=None):
    """Correlated states of users in a scan, read twice each, beside correlated weights that all share."""
    weights = numpyro.sample("weights", dist.MultivariateNormal(jnp.ones(3), COVARIANCE))

    def step(state, now):
        own, seen = now
        with numpyro.plate("user", x.shape[2]):
            state = numpyro.sample("state", dist.Normal(1.0 + RHO * state, 1.0))
            with numpyro.plate("reading", READINGS):
                mean = numpyro.deterministic("mean", state + own @ weights)
                numpyro.sample("y", dist.Normal(mean, NOISE), obs=seen)
        return state, None

    scan(step, jnp.zeros(x.shape[2]), (x, y))


COVARIANCE = jnp.array([[1.0, 0.9, 0.0], [0.9, 1.0, -0.3], [0.0, -0.3, 1.0]])
WALKS = model(
    axes={"y": ("step", "reading", "user"), "state": ("step", "user"), "mean": ("step", "reading", "user")},
    cluster="user",
)(walks)


@pytest.fixture
def walked():
    rng = np.random.default_rng(3)
    x = 0.02 * rng.normal(
        size=(STEPS, READINGS, USERS, 3)
    )  # so little that the weights' prior tells something
    y = 5 * rng.normal(size=x.shape[:-1])
    problem = Problem(WALKS, {"x": jnp.asarray(x), "y": jnp.asarray(y)}, [])
    fitted = fit(problem, problem.start({"weights": np.zeros(3), "state": np.zeros((STEPS, USERS))}))
    return problem, x, y, fitted, project(problem, fitted)


def test_data_before_a_fit_are_those_about_the_centre_of_a_correlated_prior(walked):
    """Of a linear model exactly: y - E y, whatever the fit was."""
    problem, x, y, fitted, projection = walked
    centre = np.array([sum(RHO**i for i in range(t + 1)) for t in range(STEPS)])
    expected = (y - centre[:, None, None] - x.sum(-1)) / NOISE
    before = projection.before_fit(np.asarray(problem.compiled.residual(fitted.x)))
    located = problem.rows.by_cluster(problem.rows.located) == 1
    np.testing.assert_allclose(
        np.sort(before[located]), np.sort(np.moveaxis(expected, -1, 0).reshape(-1)), rtol=1e-6
    )
    np.testing.assert_allclose(projection.origin[problem.layout["weights"].index[0]], 1.0, rtol=1e-6)


def test_replicates_have_the_covariance_of_a_correlated_prior(walked):
    problem, _, _, _, projection = walked
    step = np.eye(STEPS) - RHO * np.eye(STEPS, k=-1)
    own = np.linalg.inv(step.T @ step)
    order = np.argsort(problem.layout["state"].index[0])
    root = projection.own.root[7][np.ix_(order, order)]
    np.testing.assert_allclose(root @ root.T, own, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        projection.shared.root @ projection.shared.root.T, COVARIANCE, rtol=1e-5, atol=1e-6
    )
    drawn = projection.with_prior(
        np.zeros((4000, USERS, projection.columns.shape[1])), jax.random.split(jax.random.key(1), 4000)
    )
    w, shared = projection.local_columns[7], projection.columns[7]
    expected = w[:, order] @ own @ w[:, order].T + shared @ COVARIANCE @ shared.T
    np.testing.assert_allclose(
        np.cov(drawn[:, 7].T, bias=True), expected, atol=5 * expected.max() / np.sqrt(2000)
    )
