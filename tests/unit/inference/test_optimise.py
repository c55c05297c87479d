"""The minimiser arrives on ill-conditioned, curved and indefinite functions, and says so only when it has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.inference.optimise import DENSE_LIMIT, best, gradient_and_hessian, minimise, newton


def rosenbrock(x):
    return jnp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def stretched(x):
    return 0.5 * jnp.sum(jnp.logspace(0, 12, x.shape[0]) * (x - 1) ** 2)


def saddle(x):
    return (x[0] ** 2 - 1) ** 2 + 3 * x[1] ** 2 + 0.1 * x[0]


@pytest.mark.parametrize(
    ("function", "start", "end", "steps"),
    [
        (rosenbrock, [-1.2, 1.0, -0.5, 2.0], [1.0] * 4, 60),
        (stretched, [50.0] * 5, [1.0] * 5, 20),
        (saddle, [0.0, 2.0], [-1.0123, 0.0], 20),
    ],
)
def test_newton_arrives(function, start, end, steps):
    found = jax.jit(lambda u: newton(function, u, 200))(jnp.array(start))
    assert bool(found.converged)
    assert int(found.steps) <= steps
    np.testing.assert_allclose(found.position, end, atol=1e-4)
    assert float(found.promise) < 1e-9


def test_a_start_that_is_not_finite_is_not_called_converged():
    found = newton(lambda x: jnp.log(x[0]) + jnp.sum(x**2), jnp.array([-1.0, 2.0]), 50)
    assert not bool(found.converged)
    np.testing.assert_array_equal(found.position, [-1.0, 2.0])


def test_too_few_steps_are_not_called_converged():
    found = newton(rosenbrock, jnp.array([-1.2, 1.0]), 3)
    assert not bool(found.converged)
    assert int(found.steps) == 3
    assert float(found.value) < float(rosenbrock(jnp.array([-1.2, 1.0])))


def test_a_function_without_minimum_is_not_called_converged():
    assert not bool(newton(lambda x: -jnp.sum(x), jnp.zeros(2), 30).converged)


def test_starts_can_be_mapped_and_the_lowest_wins():
    starts = jnp.array([[0.9, 0.5], [-0.9, 0.5], [jnp.nan, 0.0]])
    found = jax.vmap(lambda u: newton(saddle, u, 100))(starts)
    lowest = best(found)
    np.testing.assert_allclose(lowest.position, [-1.0122, 0.0], atol=1e-4)
    assert not bool(found.converged[2])


@pytest.mark.parametrize("dimension", [1, 5, 33, 70])
def test_hessian_by_blocks(dimension):
    matrix = np.random.default_rng(0).normal(size=(dimension, dimension))
    matrix = matrix @ matrix.T
    point = jnp.linspace(-1, 1, dimension)
    gradient, found = gradient_and_hessian(lambda x: 0.5 * x @ matrix @ x, point)
    np.testing.assert_allclose(found, matrix, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(gradient, matrix @ point, rtol=1e-10, atol=1e-10)


def test_many_dimensions_go_by_gradients():
    size = DENSE_LIMIT + 50
    curvature = jnp.logspace(0, 2, size)
    found = minimise(lambda x: jnp.sum(curvature * (jnp.cosh(x - 0.5) - 1)), jnp.zeros(size), 200)
    assert bool(found.converged)
    np.testing.assert_allclose(found.position, 0.5, atol=0.02)
