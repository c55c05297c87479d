"""Laplace's method: exact on normals, at the mode elsewhere, and honest about where it fails."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import integrate, optimize

from dtprob.errors import InputError
from dtprob.inference import Laplace
from tests.unit.inference.examples import (
    at_the_cut,
    at_the_cut_data,
    logistic,
    logistic_data,
    normal,
    normal_data,
    normal_posterior,
)

KEY = jax.random.key(11)


def test_exact_on_a_conjugate_normal():
    data = normal_data()
    mean, spread, evidence = normal_posterior(data)
    posterior = Laplace(draws=4000)(KEY, normal, data)
    draws = posterior.draws["level"]
    assert draws.shape == (1, 4000)
    assert float(posterior.extra["log_evidence"]) == pytest.approx(evidence, rel=1e-10)
    assert float(posterior.extra["mode.level"]) == pytest.approx(mean, rel=1e-8)
    assert abs(draws.mean() - mean) < 4 * spread / 4000**0.5
    assert draws.std() == pytest.approx(spread, rel=0.05)
    assert bool(posterior.extra["converged"])
    assert int(posterior.extra["replaced"]) == 0


def poisson(y=None):
    rate = numpyro.sample("rate", dist.Gamma(2.0, 1.0))
    with numpyro.plate("row", 30):
        numpyro.sample("y", dist.Poisson(rate), obs=y)


def test_evidence_and_mode_of_a_positive_site():
    y = np.random.default_rng(0).poisson(4.0, 30)
    posterior = Laplace()(KEY, poisson, {"y": y})
    # In log(rate) the posterior is log-gamma with shape a = 2 + sum y and rate b = 31: mode log(a / b).
    shape, rate = 2.0 + y.sum(), 31.0
    assert float(posterior.extra["mode.rate"]) == pytest.approx(shape / rate, rel=1e-6)

    def log_joint(r):
        return float(dist.Gamma(2.0, 1.0).log_prob(r) + dist.Poisson(r).log_prob(y).sum())

    top = log_joint(shape / rate)
    exact = top + np.log(integrate.quad(lambda r: np.exp(log_joint(r) - top), 0.5, 9.0, points=[4.0])[0])
    assert float(posterior.extra["log_evidence"]) == pytest.approx(exact, abs=0.002)


@pytest.mark.study
def test_the_mode_agrees_with_another_optimiser():
    data = logistic_data()
    posterior = Laplace(draws=10)(KEY, logistic, data)

    def negative(u):
        scale, weight = np.exp(u[0]), u[1:]
        logits = data["x"] @ weight
        prior = -0.5 * (u[0] / 0.3) ** 2 - 0.5 * np.sum((weight / scale) ** 2) - 3 * u[0]
        return -(prior + np.sum(data["y"] * logits - np.logaddexp(0, logits)))

    found = optimize.minimize(negative, np.zeros(4), method="BFGS", options={"gtol": 1e-8}).x
    np.testing.assert_allclose(posterior.extra["mode.weight"], found[1:], rtol=1e-4)
    assert float(posterior.extra["mode.scale"]) == pytest.approx(np.exp(found[0]), rel=1e-4)


def test_an_angle_at_the_cut():
    data = at_the_cut_data()
    posterior = Laplace(draws=2000)(KEY, at_the_cut, data)
    direction = np.angle(np.exp(1j * data["y"]).sum() * 3 + 0.05)
    assert float(np.angle(np.exp(1j * (posterior.extra["mode.angle"] - direction)))) == pytest.approx(
        0, abs=1e-6
    )
    draws = posterior.draws["angle"]
    assert draws.min() < -3
    assert draws.max() > 3
    assert np.all(np.abs(draws) <= np.pi)


def two_bumps(y=None):
    x = numpyro.sample("x", dist.Normal(0.0, 3.0))
    numpyro.factor("bumps", jnp.logaddexp(-20 * (x - 2) ** 2, 3 - 20 * (x + 2) ** 2))
    numpyro.sample("y", dist.Normal(0.0, 1.0), obs=y)


def test_several_starts_find_the_higher_of_two_modes():
    low = Laplace(draws=1, initial={"x": 2.0})(KEY, two_bumps, {"y": 0.0})
    high = Laplace(draws=1, starts=8)(KEY, two_bumps, {"y": 0.0})
    assert float(low.extra["mode.x"]) == pytest.approx(2.0, abs=0.05)
    assert float(high.extra["mode.x"]) == pytest.approx(-2.0, abs=0.05)
    assert 0 < float(high.extra["agreeing"]) <= 1
    assert float(low.extra["agreeing"]) == 1


def ridge(y=None):
    x = numpyro.sample("x", dist.Normal(0.0, 1.0))
    numpyro.factor("cancels the prior", 0.5 * x**2)
    numpyro.sample("y", dist.Normal(0.0, 1.0), obs=y)


def test_a_flat_direction_is_reported():
    posterior = Laplace(draws=10)(KEY, ridge, {"y": 0.0})
    assert int(posterior.extra["replaced"]) == 1


def test_failures_and_settings_are_told():
    data = {**normal_data(), "y": np.full(12, np.inf)}
    with pytest.raises(InputError, match="a finite log density, got none at any start"):
        Laplace()(KEY, normal, data)
    with pytest.raises(InputError, match="draws of engine laplace: expected 1 or more, got 0"):
        Laplace(draws=0)(KEY, normal, normal_data())
    assert not bool(Laplace(max_steps=1, starts=1)(KEY, logistic, logistic_data()).extra["converged"])


def walk(y=None):
    """A random walk of unknown step: the density grows without bound where the step and all increments shrink."""
    step = numpyro.sample("step", dist.LogNormal(-0.5, 0.5))
    state = numpyro.sample("state", dist.GaussianRandomWalk(step, num_steps=y.shape[0]))
    with numpyro.plate("time", y.shape[0]):
        numpyro.sample("y", dist.Normal(state, 1.0), obs=y)


def known_walk(y=None):
    """The same with a known step, whose posterior is normal."""
    state = numpyro.sample("state", dist.GaussianRandomWalk(0.5, num_steps=y.shape[0]))
    with numpyro.plate("time", y.shape[0]):
        numpyro.sample("y", dist.Normal(state, 1.0), obs=y)


def test_importance_weights_tell_of_a_funnel():
    """Its answer is a step of almost zero, known exactly; all other facts of the search look well."""
    rng = np.random.default_rng(7)
    y = jnp.asarray(np.cumsum(0.5 * rng.normal(size=60)) + rng.normal(size=60))
    found = Laplace()(jax.random.key(3), walk, {"y": y})
    assert found.extra["converged"]
    assert found.extra["replaced"] == 0
    assert found.extra["pareto_k"] > 0.7
    assert Laplace()(jax.random.key(3), known_walk, {"y": y}).extra["pareto_k"] < 0.5
