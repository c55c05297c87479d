"""The complex Student t distribution against SciPy's, its limit and its quantiles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from dtprob.effects import ComplexStudentT, replace_base
from dtprob.models.complex_normal import ComplexNormal

VALUES = jnp.asarray([0.1 + 0.2j, -3.0 + 1.0j, 40.0 - 7.0j])


@pytest.mark.parametrize("tail", [0.01, 0.3, 1.0, 2.5])
def test_density_is_that_of_a_plane_student_t(tail):
    found = ComplexStudentT(0.5 - 0.1j, 2.0, tail).log_prob(VALUES)
    plane = np.stack([VALUES.real, VALUES.imag], axis=-1)
    shape = 2.0 / (1 + tail) / 2 * np.eye(2)
    expected = stats.multivariate_t([0.5, -0.1], shape, df=2 / tail).logpdf(plane)
    assert np.allclose(found, expected, rtol=1e-10)


def test_no_tail_is_the_complex_normal_to_the_bit():
    loc, variance = jnp.asarray([0.2j, 1.0, 3.0]), jnp.asarray([0.3, 2.0, 5.0])
    assert np.array_equal(
        ComplexStudentT(loc, variance, 0.0).log_prob(VALUES), ComplexNormal(loc, variance).log_prob(VALUES)
    )


def test_score_at_no_tail_is_the_second_laguerre_polynomial():
    square = jnp.abs(VALUES) ** 2 / 2.0
    score = jax.jacfwd(lambda tail: ComplexStudentT(0.0, 2.0, tail).log_prob(VALUES))(0.0)
    assert np.allclose(score, (square**2 - 4 * square + 2) / 2)


def test_density_is_smooth_where_the_series_takes_over():
    tails = jnp.asarray([0.999e-3, 1.001e-3])
    density = ComplexStudentT(0.0, 1.0, tails).log_prob(1.0 + 0.0j)
    slope = jax.vmap(jax.grad(lambda t: ComplexStudentT(0.0, 1.0, t).log_prob(1.0 + 0.0j)))(tails)
    assert np.isclose(density[1] - density[0], slope.mean() * 2e-6, rtol=1e-5)


@pytest.mark.parametrize("tail", [0.0, 0.4, 1.5])
def test_draws_follow_the_density(tail):
    fn = ComplexStudentT(1.0 + 1.0j, 3.0, tail)
    draws = np.asarray(fn.sample(jax.random.key(0), (4000,)))
    square = np.abs(draws - (1 + 1j)) ** 2 * (1 + tail) / 3.0

    def distribution(q):
        return 1 - np.exp(-q) if tail == 0 else 1 - (1 + tail * q) ** (-1 / tail)

    assert stats.kstest(square, distribution).pvalue > 1e-3
    assert stats.kstest(np.angle(draws - (1 + 1j)), stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > 1e-3
    assert fn.mean == 1 + 1j
    assert fn.batch_shape == ()


def test_only_the_innermost_distribution_is_replaced():
    loc, mask = jnp.arange(6.0).reshape(3, 2) + 0j, jnp.asarray([True, False, True])
    fn = ComplexNormal(loc, 2.0).to_event(1).mask(mask).expand((4, 3))
    found = replace_base(fn, lambda base: ComplexStudentT(base.loc, base.variance, 0.3))
    assert (found.batch_shape, found.event_shape) == ((4, 3), (2,))
    value = jnp.ones((4, 3, 2)) + 0j
    expected = jnp.where(mask, ComplexStudentT(loc, 2.0, 0.3).log_prob(value[0]).sum(-1), 0.0)
    assert np.allclose(found.log_prob(value), np.broadcast_to(expected, (4, 3)))
