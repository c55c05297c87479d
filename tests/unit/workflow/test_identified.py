"""Contraction against closed forms, and what a summary says of a parameter that the data do not know."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.inference import Posterior
from dtprob.models.dirichlet import LogDirichlet
from dtprob.workflow.identified import contraction
from dtprob.workflow.summary import summarise


def line(x, y=None):
    known = numpyro.sample("known", dist.Normal(0.0, 3.0).expand([2]).to_event(1))
    idle = numpyro.sample("idle", dist.Normal(0.0, 1.0))
    angle = numpyro.sample("angle", dist.VonMises(0.0, 1e-9))
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(known[0] + 0.0 * (idle + angle), 1.0), obs=y)


@pytest.fixture(scope="module")
def found():
    """Draws as an exact posterior would have them: `known[0]` a third as wide as its prior, the others no narrower."""
    random = np.random.default_rng(0)
    shape = (4, 2000)
    known = np.stack([random.normal(2, 1, shape), np.full(shape, 0.4)], axis=-1)
    draws = {
        "known": known,
        "idle": random.normal(size=shape),
        "angle": random.uniform(-np.pi, np.pi, shape),
    }
    stats = {"diverging": np.zeros(shape, bool)}
    posterior = Posterior(draws=draws, sample_stats=stats, latent=tuple(draws), circular=("angle",))
    data = {"x": jnp.zeros(3), "y": jnp.zeros(3)}
    return posterior, contraction(posterior, line, data, list(draws))


def test_contraction_is_one_minus_the_ratio_of_variances(found):
    _, values = found
    assert values["known"][0] == pytest.approx(8 / 9, abs=0.03)
    assert np.isnan(values["known"][1])  # all draws the same
    assert float(values["idle"]) == pytest.approx(0.0, abs=0.24)
    assert float(values["angle"]) == pytest.approx(0.0, abs=0.24)


@pytest.mark.filterwarnings("error")
def test_an_outcome_that_cannot_happen_has_no_contraction():
    allowed = np.array([[True, True, False]])

    def table(y=None):
        level = numpyro.sample("table", LogDirichlet(1.0, allowed))[0, 0]
        with numpyro.plate("row", 3):
            numpyro.sample("y", dist.Normal(level, 1.0), obs=y)

    half = np.random.default_rng(0).uniform(size=(1, 4000))
    draws = np.stack([np.log(half), np.log(1 - half), np.full_like(half, -np.inf)], axis=-1)[:, :, None]
    posterior = Posterior(draws={"table": draws}, latent=("table",))
    (found,) = contraction(posterior, table, {"y": jnp.zeros(3)}, ["table"])["table"]
    np.testing.assert_allclose(found[:2], 0.0, atol=0.5)
    assert np.isnan(found[2])


def test_a_summary_names_what_is_not_identified(found):
    posterior, _ = found
    values = {"known": np.array([0.7, np.nan]), "idle": np.asarray(0.03), "angle": np.asarray(0.2)}
    told = summarise(posterior, values)
    assert told["parameters"]["known[0]"]["contraction"] == pytest.approx(0.7)
    assert "contraction" not in told["parameters"]["known[1]"]
    said = [text for text in told["warnings"] if "not identified" in text]
    assert len(said) == 1
    assert "say nothing of idle " in said[0]
    assert "angle" not in said[0]
