"""The engine that is chosen follows from the model's structure, and the reason is kept."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.errors import InputError
from dtprob.inference import Auto, Exact, Posterior, choose
from dtprob.inference import auto as auto_module
from tests.unit.inference.examples import (
    at_the_cut,
    at_the_cut_data,
    logistic,
    logistic_data,
    normal,
    normal_data,
    normal_posterior,
    phase_errors,
    phase_errors_data,
)

KEY = jax.random.key(2)


def many(x, y=None):
    with numpyro.plate("column", x.shape[1]):
        weight = numpyro.sample("weight", dist.Laplace(0.0, 1.0))
    with numpyro.plate("row", x.shape[0]):
        numpyro.sample("y", dist.Normal(x @ weight, 1.0), obs=y)


CASES = {
    "a normal posterior": (normal, normal_data(), "exact", "closed form"),
    "few unknowns": (logistic, logistic_data(), "nuts", "4 unknowns"),
    "few angles": (at_the_cut, at_the_cut_data(), "nuts", "2 of them angles"),
    "many angles": (phase_errors, phase_errors_data(200)[0], "von_mises_em", "affine in each angle"),
    "many unknowns": (many, {"x": np.ones((3, 600)), "y": np.ones(3)}, "svi", "more than 500"),
}


@pytest.mark.study
@pytest.mark.parametrize("name", CASES)
def test_choice(name):
    model, data, engine, reason = CASES[name]
    choice = choose(model, data, draws=7)
    assert choice.engine.name == engine
    assert reason in choice.reason
    assert dataclasses.asdict(choice.engine)["draws"] == 7


def test_work_counts_as_size_does(monkeypatch):
    monkeypatch.setattr(auto_module, "MOST_WORK", 1.0)
    choice = choose(logistic, logistic_data())
    assert (choice.engine.name, "operations: too many" in choice.reason) == ("svi", True)


def test_the_reason_is_kept_in_the_file(tmp_path):
    posterior = Auto(draws=20)(KEY, normal, normal_data())
    posterior.save(tmp_path / "posterior.nc")
    facts = Posterior.load(tmp_path / "posterior.nc").provenance
    assert (facts["engine"], facts["chosen_by"], facts["chosen"]) == ("exact", "auto", "exact")
    assert "quadratic" in facts["reason"]


def test_a_normal_posterior_in_closed_form():
    data = normal_data()
    mean, spread, evidence = normal_posterior(data)
    posterior = Exact(draws=4000)(KEY, normal, data)
    assert posterior.extra["log_evidence"] == pytest.approx(evidence)
    assert posterior.extra["mode.level"] == pytest.approx(mean)
    draws = posterior.draws["level"]
    assert abs(draws.mean() - mean) < 4 * spread / draws.size**0.5
    assert draws.std() == pytest.approx(spread, rel=4 / (2 * draws.size) ** 0.5)


def far_from_normal(y=None):
    """Quadratic around the prior's median, and nowhere near the data."""
    level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    numpyro.sample("y", dist.Normal(level + jnp.where(level > 5.0, (level - 5.0) ** 2, 0.0), 1.0), obs=y)


@pytest.mark.parametrize(
    ("model", "data", "reason"),
    [
        (logistic, logistic_data(), "not quadratic"),
        (at_the_cut, at_the_cut_data(), "an angle"),
        (far_from_normal, {"y": 30.0}, "not quadratic"),
    ],
)
def test_what_has_no_closed_form_is_refused_with_the_reason(model, data, reason):
    with pytest.raises(InputError, match=reason):
        Exact()(KEY, model, data)
