"""Tables of log-probabilities: density, coordinates and draws against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.distributions import biject_to
from scipy import special

from dtprob.errors import InputError
from dtprob.models.dirichlet import LogDirichlet, log_shares

ALLOWED = np.array([[True, True, False], [True, True, True], [True, False, False]])
CONCENTRATION = np.array([[0.5, 2.0, 1.0], [1.0, 3.0, 0.7], [4.0, 1.0, 1.0]])


def table():
    return LogDirichlet(CONCENTRATION, ALLOWED)


def test_coordinates_come_back():
    transform = biject_to(table().support)
    u = jax.random.normal(jax.random.key(0), (5, 3)) * 50
    x = transform(u)
    assert x.shape == (5, 3, 3)
    assert transform.inverse_shape((5, 3, 3)) == (5, 3)
    np.testing.assert_allclose(transform.inv(x), u, rtol=1e-9, atol=1e-9)
    assert np.all(table().support(x))
    assert np.array_equal(np.isneginf(x[0]), ~ALLOWED)


def test_density_is_that_of_the_probabilities():
    x = table().sample(jax.random.key(1), (4,))
    p = np.exp(np.asarray(x))
    expected = dist.Dirichlet(CONCENTRATION[0, :2]).log_prob(p[:, 0, :2])
    expected += dist.Dirichlet(CONCENTRATION[1]).log_prob(p[:, 1])
    np.testing.assert_allclose([table().log_prob(one) for one in x], expected, rtol=1e-6)


def test_jacobian_agrees_with_differentiation():
    transform = biject_to(LogDirichlet(1.0, ALLOWED[1:2]).support)
    u = jnp.array([0.3, -1.2])
    jacobian = jax.jacfwd(lambda v: jnp.exp(transform(v))[0, 1:])(u)
    expected = jnp.linalg.slogdet(jacobian)[1]
    np.testing.assert_allclose(transform.log_abs_det_jacobian(u, transform(u)), expected, rtol=1e-10)


def test_draws_of_a_small_concentration_do_not_underflow():
    x = np.asarray(LogDirichlet(0.01, np.ones(4, dtype=bool)).sample(jax.random.key(2), (20_000,)))
    assert np.all(np.isfinite(x))
    expected = special.digamma(0.01) - special.digamma(0.04)
    error = x.std() / np.sqrt(len(x))
    np.testing.assert_allclose(x.mean(axis=0), expected, atol=4.5 * error)


def test_shares_of_counts():
    shares = np.exp(log_shares(np.array([[3.0, 1.0, 9.0], [0.0, 0.0, 0.0]]), ALLOWED[:2]))
    np.testing.assert_allclose(shares, [[0.75, 0.25, 0.0], [1 / 3, 1 / 3, 1 / 3]])


def test_a_row_in_which_nothing_can_happen_is_refused():
    with pytest.raises(InputError, match=r"one or more in each row, got none in \(1,\)"):
        LogDirichlet(1.0, np.array([[True, True], [False, False]]))
