"""Tangents along unknowns of many entries are taken by themselves, and are the same."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.gap.model.problem import Problem

PLACES = 40
X = np.linspace(0.0, 10.0, PLACES)


def process(x, y=None, *, factor=jnp.linalg.cholesky):
    """A Gaussian process of unknown spread and length, read at each place."""
    spread = numpyro.sample("spread", dist.LogNormal(0.0, 0.5))
    length = numpyro.sample("length", dist.LogNormal(0.0, 0.5))
    noise = numpyro.sample("noise", dist.LogNormal(-1.0, 0.5))
    state = numpyro.sample("state", dist.Normal(0.0, 1.0).expand([x.shape[0]]).to_event(1))
    covariance = jnp.exp(-jnp.abs(x[:, None] - x) / length) + 1e-6 * jnp.eye(x.shape[0])
    level = numpyro.deterministic("level", spread * factor(covariance) @ state)
    with numpyro.plate("place", x.shape[0]):
        numpyro.sample("y", dist.Normal(level, noise), obs=y)


@pytest.fixture(scope="module")
def problem():
    return Problem(process, {"x": jnp.asarray(X), "y": jnp.asarray(np.sin(X))}, [])


@pytest.fixture(scope="module")
def point(problem):
    return 0.3 * np.random.default_rng(0).normal(size=problem.dimension)


def directions(problem):
    """Of a state, of all unknowns but the noise, of another state, of two states, of the length."""
    rng, every = np.random.default_rng(1), np.eye(problem.dimension)
    state = every[problem.layout["state"].index[0]]
    others = rng.normal(size=problem.dimension)
    others[problem.layout["noise"].index] = 0.0
    return np.stack(
        [state[3], others, state[30], state[4] - 2 * state[5], every[problem.layout["length"].offset]]
    )


@pytest.mark.parametrize("chosen", [[0, 1, 2, 3, 4], [0, 2, 3], [1, 4], []])
def test_tangents_are_differences_of_what_is_expected(chosen, problem, point):
    basis = directions(problem)[chosen]
    residual, columns = problem.compiled.linearised(point, basis)
    sites = problem.compiled.sites(point)
    np.testing.assert_allclose(residual[:, 0], (np.sin(X) - sites["level"]) / sites["noise"], rtol=1e-9)
    step = 1e-5
    for column, direction in zip(np.moveaxis(np.asarray(columns), -1, 0), basis, strict=True):
        up, down = (problem.compiled.sites(point + sign * step * direction)["level"] for sign in (1.0, -1.0))
        np.testing.assert_allclose(column[:, 0], (up - down) / (2 * step) / sites["noise"], atol=1e-7)


def test_what_states_do_not_enter_is_not_differentiated_along_them(point):
    @jax.custom_jvp
    def factor(covariance):
        return jnp.linalg.cholesky(covariance)

    @factor.defjvp
    def _(_primals, _tangents):
        pytest.fail("differentiated")

    def held(x, y=None):
        return process(x, y, factor=factor)

    problem = Problem(held, {"x": jnp.asarray(X), "y": jnp.asarray(np.sin(X))}, [])
    states = directions(problem)[[0, 2, 3]]
    plain = Problem(process, {"x": jnp.asarray(X), "y": jnp.asarray(np.sin(X))}, [])
    np.testing.assert_allclose(
        problem.compiled.linearised(point, states)[1], plain.compiled.linearised(point, states)[1], rtol=1e-9
    )
    with pytest.raises(pytest.fail.Exception, match="differentiated"):
        problem.compiled.linearised(point, directions(problem)[[1]])
