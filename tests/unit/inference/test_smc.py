"""Sequential Monte Carlo: evidences against closed forms, and the share of each mode."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import special, stats

from dtprob.errors import InputError
from dtprob.inference import SMC, summary
from dtprob.inference.build import build_target
from dtprob.inference.smc import Swarm, _covariance
from tests.unit.inference.examples import at_the_cut, at_the_cut_data, normal, normal_data, normal_posterior

KEY = jax.random.key(6)
SHORT = {"draws": 500, "moves": 3, "leapfrog": 6}


def check_evidence(posterior, evidence):
    """The runs' spread tells the estimate's error; four standard errors of it, by Student's law with 3 degrees."""
    runs = posterior.extra["log_evidence_of_runs"]
    error = runs.std(ddof=1) / len(runs) ** 0.5
    assert error < 0.1
    assert abs(runs.mean() - evidence) < stats.t.isf(5e-4, len(runs) - 1) * error


def test_normal_evidence_and_posterior():
    data = normal_data()
    mean, spread, evidence = normal_posterior(data)
    posterior = SMC(**SHORT)(KEY, normal, data)
    check_evidence(posterior, evidence)
    row = summary(posterior).loc["level"]
    assert abs(row["mean"] - mean) < 4 * spread / row["ess"] ** 0.5
    assert row["sd"] == pytest.approx(spread, rel=0.1)
    temperatures = posterior.extra["temperatures"]
    assert np.all(np.diff(temperatures) >= 0)
    assert temperatures[-1] == 1


@pytest.mark.study
def test_evidence_of_angles_across_the_cut():
    data = at_the_cut_data()
    posterior = SMC(**SHORT)(KEY, at_the_cut, data)
    eta = abs(3.0 * np.exp(1j * data["y"]).sum() + 0.05)

    def log_integral(kappa):
        return np.log(special.i0e(kappa)) + kappa

    evidence = log_integral(eta) - log_integral(0.05) - 15 * (np.log(2 * np.pi) + log_integral(3.0))
    check_evidence(posterior, evidence)
    table = summary(posterior)
    assert table.loc["angle", "resultant_length"] == pytest.approx(1 - 0.5 / eta, abs=0.01)
    assert table.loc["free", "resultant_length"] < 0.1


def two_modes(y=None):
    """The data tell the square only; the prior prefers one of the signs."""
    level = numpyro.sample("level", dist.Normal(0.05, 1.0))
    numpyro.sample("y", dist.Normal(jnp.square(level), 0.1), obs=y)


def test_each_mode_keeps_its_share():
    """Share of the positive mode by quadrature: a binomial count, its size the particles that differ."""
    x = np.linspace(-3, 3, 20_001)
    density = stats.norm.pdf(x, 0.05, 1.0) * stats.norm.pdf(2.0, x**2, 0.1)
    share = density[x > 0].sum() / density.sum()
    posterior = SMC(draws=1000, chains=2, moves=2, leapfrog=5)(KEY, two_modes, {"y": 2.0})
    found = np.mean(posterior.draws["level"] > 0)
    # Each resampling (there are about ten) loses a share of the particles' variety: a quarter of them counts.
    assert abs(found - share) < 4 * (share * (1 - share) / 500) ** 0.5
    assert np.abs(posterior.draws["level"]).mean() == pytest.approx(
        np.sum(np.abs(x) * density) / density.sum(), abs=0.01
    )


def test_a_particle_at_the_edge_of_its_support_does_not_stop_the_others():
    """As a draw of Gamma(.01) that was rounded to zero; its weight is zero once the likelihood counts."""
    target, _ = build_target(normal, normal_data())
    particles = jnp.asarray([-jnp.inf, *np.random.default_rng(0).normal(size=99)])[:, None]
    for first in (0.01, 0.0):
        weights = jnp.full(100, (1 - first) / 99).at[0].set(first)
        covariance = _covariance(target, Swarm(particles, weights, *[jnp.zeros(())] * 7))
        expected = float(np.var(particles[1:]))
        assert float(covariance[0, 0]) == pytest.approx(expected, rel=0.05)


def test_what_it_cannot_do_is_an_error():
    with pytest.raises(InputError, match="within 1 temperatures"):
        SMC(**SHORT, max_temperatures=1)(KEY, normal, normal_data())
    with pytest.raises(InputError, match="target_ess of engine smc: expected between 0 and 1"):
        SMC(target_ess=1.5)(KEY, normal, normal_data())


def test_the_last_temperature_that_is_allowed_may_be_the_posterior():
    temperatures = SMC(**SHORT, chains=1)(KEY, normal, normal_data()).extra["temperatures"]
    just = SMC(**SHORT, chains=1, max_temperatures=len(temperatures) - 1)(KEY, normal, normal_data())
    np.testing.assert_array_equal(just.extra["temperatures"], temperatures)


def test_data_that_no_draw_of_the_prior_allows_are_refused_before_the_first_temperature():
    """It went on to the last temperature that it was given."""
    data = {**normal_data(), "y": np.full(12, np.inf)}
    with pytest.raises(
        InputError, match="model normal: expected a finite log density, got none at any start"
    ):
        SMC(**SHORT, chains=1, max_temperatures=3)(KEY, normal, data)
