"""Rows of each family of numbers tell how probable smaller values are: exactly, and nearly where a fit changed them."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from dtprob.gap.observation.likelihoods import LIKELIHOODS

FAMILIES = {
    "Exponential": ({"rate": 2.0}, stats.expon(scale=0.5)),
    "Gamma": ({"concentration": 3.0, "rate": 2.0}, stats.gamma(3.0, scale=0.5)),
    "InverseGamma": ({"concentration": 3.0, "rate": 2.0}, stats.invgamma(3.0, scale=2.0)),
    "Weibull": ({"scale": 1.5, "concentration": 2.2}, stats.weibull_min(2.2, scale=1.5)),
    "HalfNormal": ({"scale": 0.7}, stats.halfnorm(scale=0.7)),
    "Beta": ({"concentration1": 3.0, "concentration0": 1.5}, stats.beta(3.0, 1.5)),
    "StudentT": ({"df": 4.0, "loc": 1.0, "scale": 0.3}, stats.t(4.0, 1.0, 0.3)),
    "Cauchy": ({"loc": 1.0, "scale": 0.3}, stats.cauchy(1.0, 0.3)),
    "Laplace": ({"loc": 1.0, "scale": 0.3}, stats.laplace(1.0, 0.3)),
    "Logistic": ({"loc": 1.0, "scale": 0.3}, stats.logistic(1.0, 0.3)),
    "Gumbel": ({"loc": 1.0, "scale": 0.3}, stats.gumbel_r(1.0, 0.3)),
    "VonMises": ({"loc": 1.0, "concentration": 3.0}, stats.vonmises(3.0, loc=1.0)),
}


COUNTS = {
    "Poisson": ({"rate": 6.0}, stats.poisson(6.0)),
    "BinomialLogits": ({"total_count": 20.0, "logits": 0.5}, stats.binom(20, 1 / (1 + np.exp(-0.5)))),
    "BinomialProbs": ({"total_count": 20.0, "probs": 0.3}, stats.binom(20, 0.3)),
    "GammaPoisson": ({"concentration": 4.0, "rate": 0.5}, stats.nbinom(4.0, 1 / 3)),
    "GeometricProbs": ({"probs": 0.2}, stats.geom(0.2, loc=-1)),
}
AT_ZERO = {"Exponential": 1, "Gamma": 1, "Weibull": 1, "HalfNormal": 1, "InverseGamma": -1}
"""Families of which values near zero, or far from it, tell only that they are."""


def rows(family, probability):
    """Parameters, and the rows of values of which smaller ones have these probabilities."""
    given, law = FAMILIES[family]
    parameters = {name: jnp.asarray(value) for name, value in given.items()}
    value = jnp.asarray(law.ppf(probability))
    return parameters, LIKELIHOODS[family].residual(parameters, value)


def told(family, parameters, own):
    return np.asarray(LIKELIHOODS[family].probability(parameters, own))


def test_every_family_of_numbers_that_is_not_normal_tells_it():
    telling = {name for name, known in LIKELIHOODS.items() if known.probability is not None}
    assert telling == {*FAMILIES, *COUNTS}
    normal = {name for name, known in LIKELIHOODS.items() if known.log_scale is not None}
    others = {name for name, known in LIKELIHOODS.items() if known.is_outcome or known.is_complex}
    assert set(LIKELIHOODS) - telling - normal - others == {"BetaBinomial"}


@pytest.mark.parametrize("family", COUNTS)
def test_of_counts_half_of_those_that_are_as_large_count_as_smaller(family):
    given, law = COUNTS[family]
    parameters = {name: jnp.asarray(value) for name, value in given.items()}
    count = np.arange(int(law.ppf(0.001)), int(law.ppf(0.999)) + 1)
    found = told(family, parameters, LIKELIHOODS[family].residual(parameters, jnp.asarray(count, float)))
    np.testing.assert_allclose(found, law.cdf(count) - law.pmf(count) / 2, atol=0.03)
    assert np.all(np.diff(found) > 0)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_rows_of_a_value_tell_its_probability(family):
    probability = np.linspace(0.001, 0.999, 999)
    found = told(family, *rows(family, probability))
    end = AT_ZERO.get(family, 0)
    exact = (probability > 0.1 if end > 0 else True) & (probability < 0.9 if end < 0 else True)
    np.testing.assert_allclose(found[exact], probability[exact], atol=1e-6)
    np.testing.assert_allclose(found, probability, atol=0.1)
    assert np.all(np.diff(found) >= 0)


@pytest.mark.parametrize("family", FAMILIES)
def test_far_values_stay_far(family):
    probability = np.array([1e-7, 1e-5, 1 - 1e-5, 1 - 1e-7])
    found = told(family, *rows(family, probability))
    end = AT_ZERO.get(family, 0)
    assert np.all(found[:2] < (0.1 if end > 0 else 2e-5))
    assert np.all(found[2:] > 1 - (0.1 if end < 0 else 2e-5))


@pytest.mark.parametrize("family", FAMILIES)
def test_what_a_fit_changes_a_little_changes_little(family):
    """A tenth of a standard deviation in each row: the score of a value errs by about as much, and is always finite."""
    rng = np.random.default_rng(0)
    probability = rng.uniform(0.01, 0.99, 2000)
    parameters, own = rows(family, probability)
    near = told(family, parameters, own + 0.1 * jnp.asarray(rng.normal(size=own.shape)))
    assert np.all((near >= 0) & (near <= 1))
    assert np.mean(np.abs(near - probability)) < 0.06
    wild = told(family, parameters, own + 30.0 * jnp.asarray(rng.normal(size=own.shape)))
    assert np.all((wild >= 0) & (wild <= 1))
