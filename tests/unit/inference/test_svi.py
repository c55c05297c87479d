"""Variational inference: exact where the guide holds the posterior, and honest where it does not."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import special

from dtprob.inference import SVI
from dtprob.inference.weights import weight_facts
from tests.unit.inference.examples import at_the_cut, at_the_cut_data, normal, normal_data, normal_posterior

KEY = jax.random.key(5)


def test_a_normal_posterior_is_found_exactly():
    data = normal_data()
    mean, spread, evidence = normal_posterior(data)
    posterior = SVI(draws=4000)(KEY, normal, data)
    assert posterior.extra["elbo"] == pytest.approx(evidence, abs=1e-6)
    assert posterior.extra["log_evidence"] == pytest.approx(evidence, abs=1e-6)
    assert posterior.extra["pareto_k"] < 0.5
    assert posterior.extra["converged"]
    draws = posterior.draws["level"]
    assert abs(draws.mean() - mean) < 4 * spread / draws.size**0.5
    assert draws.std() == pytest.approx(spread, rel=4 / (2 * draws.size) ** 0.5)
    fewer = SVI(draws=50)(KEY, normal, data)
    np.testing.assert_allclose(fewer.draws["level"], draws[:, :50], rtol=1e-12)


def test_von_mises_posteriors_are_found_exactly():
    """Conjugate angles, one of them across the cut: directions and concentrations are those of the closed form."""
    data = at_the_cut_data()
    posterior = SVI(draws=500)(KEY, at_the_cut, data)
    eta = 3.0 * np.exp(1j * data["y"]).sum() + 0.05
    assert posterior.extra["concentration.angle"] == pytest.approx(abs(eta), rel=1e-3)
    assert posterior.extra["concentration.free"] < 0.05
    error = np.angle(np.exp(1j * (posterior.draws["angle"] - np.angle(eta)))).mean()
    assert abs(error) < 4 / abs(eta) ** 0.5 / 500**0.5

    def log_integral(kappa):
        return np.log(special.i0e(kappa)) + kappa

    evidence = log_integral(abs(eta)) - log_integral(0.05) - 15 * (np.log(2 * np.pi) + log_integral(3.0))
    assert posterior.extra["elbo"] == pytest.approx(evidence, abs=5e-3)
    assert np.all(np.abs(posterior.draws["angle"]) <= np.pi)


def pair(y=None):
    """Two levels of which the data tell the sum: a strongly correlated normal posterior."""
    with numpyro.plate("part", 2):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    numpyro.sample("y", dist.Normal(level.sum(), 0.2), obs=y)


def correlated():
    precision = np.eye(2) + 25 * np.ones((2, 2))
    return np.linalg.inv(precision)


@pytest.mark.parametrize(
    "guide",
    [*(pytest.param(name, marks=pytest.mark.study) for name in ("mean_field", "low_rank")), "full_rank"],
)
def test_covariances_are_those_that_the_family_allows(guide):
    """Mean field: the variances are one over the precision's diagonal; the others hold the whole covariance."""
    posterior = SVI(guide=guide, rank=1, draws=3000)(KEY, pair, {"y": 1.0})
    covariance = correlated()
    if guide == "mean_field":
        covariance = np.diag(1 / np.diag(np.linalg.inv(covariance)))
    # Sampling moves an entry by one part in forty; the low-rank family stops within a few hundredths of a nat.
    np.testing.assert_allclose(np.cov(posterior.flat("level").T), covariance, atol=0.1 * covariance.max())
    assert (posterior.extra["pareto_k"] > 0.5) == (guide == "mean_field")


def test_weights_of_known_tails():
    """Weights of Pareto's law with index k have index k; equal weights tell the evidence and have no tail."""
    uniform = np.random.default_rng(0).uniform(size=20_000)
    for index in (0.3, 0.9):
        assert weight_facts(-index * np.log(uniform))["pareto_k"] == pytest.approx(index, abs=0.15)
    assert weight_facts(np.full(100, -3.0)) == {"pareto_k": -np.inf, "log_evidence": pytest.approx(-3.0)}
    assert np.isnan(weight_facts(np.zeros(10))["pareto_k"])


def test_a_bound_that_is_no_number_has_not_converged():
    """The density is NaN for a third of the prior."""

    def torn(y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
        numpyro.sample("y", dist.Normal(jnp.where(level > 0.5, jnp.nan, level), 1.0), obs=y)

    found = SVI(draws=100, steps=400, falls=1, starts=1)(KEY, torn, {"y": jnp.asarray(0.4)}).extra
    assert not np.isfinite(found["elbo"])
    assert not found["converged"]
