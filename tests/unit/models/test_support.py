"""Observed values outside the support of their distribution are refused; all others are let through."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.errors import InputError
from dtprob.models.support import check_support


def unknown():
    return jnp.exp(numpyro.sample("a", dist.Normal(0.0, 0.5)))


FAMILIES = {
    "Bernoulli": (lambda: dist.Bernoulli(0.3), [0, 1, 1], [0, 2, 1]),
    "Binomial": (lambda: dist.Binomial(jnp.array([3, 3, 3]), 0.3), [0, 3, 1], [0, 4, 1]),
    "Poisson": (lambda: dist.Poisson(unknown()), [0, 9, 1], [0.0, 2.5, 1.0]),
    "Gamma": (lambda: dist.Gamma(2 * unknown() + 1.0, 1.0), [0.1, 9.0, 1.0], [0.1, 0.0, 1.0]),
    "Beta": (lambda: dist.Beta(2 * unknown() + 1.0, 3.0), [0.1, 0.9, 0.2], [0.1, 1.0, 0.2]),
    "Exponential": (lambda: dist.Exponential(unknown()), [0.0, 9.0, 1.0], [0.1, -0.1, 1.0]),
    "Uniform": (lambda: dist.Uniform(0.0, 3 * unknown()), [0.1, 1.0, 0.5], [0.1, -1.0, 0.5]),
    "Categorical": (lambda: dist.Categorical(jnp.full(3, 1 / 3)), [0, 2, 1], [0, 3, 1]),
    "Mixture": (
        lambda: dist.MixtureSameFamily(
            dist.Categorical(jnp.full(2, 0.5)), dist.Gamma(jnp.array([2.0, 3.0]), 1.0)
        ),
        [0.1, 9.0, 1.0],
        [0.1, -9.0, 1.0],
    ),
}


def observing(make):
    def model(y=None):
        with numpyro.plate("row", 3):
            numpyro.sample("y", make(), obs=y)

    return model


@pytest.mark.parametrize("family", FAMILIES)
def test_what_a_distribution_cannot_take_is_refused(family):
    make, right, wrong = FAMILIES[family]
    check_support(observing(make), {"y": jnp.asarray(right)})
    with pytest.raises(
        InputError, match=rf"'y': expected values that {family}\w* can take, got \S+ at \[1\]\. Correct"
    ):
        check_support(observing(make), {"y": jnp.asarray(wrong)})


@pytest.mark.parametrize(
    ("make", "values"),
    [
        (lambda: dist.VonMises(0.0, 2.0), [0.0, 6.0, -9.0]),
        (lambda: dist.Normal(unknown(), 1.0), [0.0, -6.0, 1e9]),
        (lambda: dist.Poisson(unknown()).mask(jnp.array([True, False, True])), [0, -1, 2]),
        (
            lambda: dist.LeftCensoredDistribution(dist.Normal(0.0, 1.0), censored=jnp.array([1, 0, 0])),
            [-3.0, 0, 1],
        ),
    ],
    ids=["angles", "real numbers", "masked", "censored"],
)
def test_angles_from_anywhere_and_what_does_not_count_are_let_through(make, values):
    check_support(observing(make), {"y": jnp.asarray(values)})


def test_entries_of_vectors_are_looked_at_together():
    def model(y=None):
        with numpyro.plate("row", 4):
            numpyro.sample("y", dist.Gamma(2.0, 1.0).expand([3]).to_event(1), obs=y)

    values = np.ones((4, 3))
    check_support(model, {"y": jnp.asarray(values)})
    values[2, 1] = -1.0
    values[3, 0] = 0.0
    with pytest.raises(InputError, match=r"Gamma can take, got \[ 1\., -1\.,  1\.\] at \[2\] and 1 more"):
        check_support(model, {"y": jnp.asarray(values)})


def test_the_first_site_of_the_model_is_named():
    """The number of trials, which is observed, too, allows nothing if it is wrong itself."""

    def model(sent=None, lost=None):
        with numpyro.plate("row", 3):
            count = numpyro.sample("sent", dist.Poisson(10.0), obs=sent)
            numpyro.sample("lost", dist.Binomial(count, 0.3), obs=lost)

    data = {"sent": jnp.array([9, -3, 9]), "lost": jnp.array([1, 2, 3])}
    with pytest.raises(InputError, match="'sent'"):
        check_support(model, data)


def uniform_below(y=None):
    end = numpyro.sample("end", dist.Pareto(0.1, 1.0))
    with numpyro.plate("row", 3):
        numpyro.sample("y", dist.Uniform(0.0, end), obs=y)


def test_a_value_beyond_an_unknown_end_is_let_through_where_few_prior_draws_allow_it():
    check_support(uniform_below, {"y": jnp.array([0.1, 50.0, 1.0])})
    with pytest.raises(InputError, match=r"got -1\.0* at \[1\]\. Correct"):
        check_support(uniform_below, {"y": jnp.array([0.1, -1.0, 1.0])})
