"""What data say of parameters, against closed forms, and what a summary says of those it does not know or contradict."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.inference import Posterior
from dtprob.models.dirichlet import LogDirichlet
from dtprob.workflow.identified import Learnt, learnt
from dtprob.workflow.summary import summarise

SHAPE = (4, 2000)


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
    known = np.stack([random.normal(2, 1, SHAPE), np.full(SHAPE, 0.4)], axis=-1)
    draws = {
        "known": known,
        "idle": random.normal(size=SHAPE),
        "angle": random.uniform(-np.pi, np.pi, SHAPE),
    }
    stats = {"diverging": np.zeros(SHAPE, bool)}
    posterior = Posterior(draws=draws, sample_stats=stats, latent=tuple(draws), circular=("angle",))
    data = {"x": jnp.zeros(3), "y": jnp.zeros(3)}
    return posterior, learnt(posterior, line, data, list(draws))


def test_contraction_is_one_minus_the_ratio_of_variances(found):
    _, values = found
    assert values["known"].contraction[0] == pytest.approx(8 / 9, abs=0.03)
    assert np.isnan(values["known"].contraction[1])  # all draws the same
    assert float(values["idle"].contraction) == pytest.approx(0.0, abs=0.24)
    assert float(values["angle"].contraction) == pytest.approx(0.0, abs=0.24)


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
    (found,) = learnt(posterior, table, {"y": jnp.zeros(3)}, ["table"])["table"].contraction
    np.testing.assert_allclose(found[:2], 0.0, atol=0.5)
    assert np.isnan(found[2])


def test_a_summary_names_what_is_not_identified(found):
    posterior, values = found
    told = summarise(posterior, values)
    assert told["parameters"]["known[0]"]["contraction"] == pytest.approx(8 / 9, abs=0.03)
    assert "contraction" not in told["parameters"]["known[1]"]
    said = [text for text in told["warnings"] if "not identified" in text]
    assert len(said) == 1
    assert "say nothing of idle, angle (" in said[0]
    assert not [text for text in told["warnings"] if "contradict" in text]


def skewed(y=None):
    level = numpyro.sample("level", dist.LogNormal(1.0, 2.0))
    turn = numpyro.sample("turn", dist.VonMises(0.5, 100.0))
    numpyro.sample("y", dist.Normal(level + turn, 1.0), obs=y)


def of_skewed(score, width, turn=0.5):
    """A posterior on `skewed` with the logarithm of `level` so many prior deviations away and so many times as wide."""
    random = np.random.default_rng(1)
    draws = {
        "level": np.exp(1 + 2 * (score + width * random.normal(size=SHAPE))),
        "turn": random.normal(turn, 0.02, SHAPE),
    }
    posterior = Posterior(draws=draws, latent=tuple(draws), circular=("turn",))
    return posterior, learnt(posterior, skewed, {"y": jnp.zeros(())}, list(draws))


@pytest.mark.parametrize("score", [-12.0, -3.5, -1.0, 0.0, 1.0, 3.5, 12.0])
@pytest.mark.parametrize("width", [0.1, 1.0, 1.5])
def test_shift_and_width_are_those_of_the_scale_on_which_the_prior_is_normal(score, width):
    """The prior has 1024 draws, whose quantiles at two deviations are known to .1; the line beyond them to a tenth."""
    found = of_skewed(score, width)[1]["level"]
    assert float(found.shift) == pytest.approx(score, abs=0.2 + 0.15 * max(abs(score) - 2, 0))
    assert float(found.width) == pytest.approx(width, rel=0.25)


def warned(*arguments):
    return [text for text in summarise(*arguments)["warnings"] if "prior" in text]


def test_a_prior_that_the_data_contradict_is_named_and_not_called_unidentified():
    for case in ((-6.0, 0.5), (6.0, 1.0), (0.0, 4.0)):
        (text,) = warned(*of_skewed(*case))
        assert text.startswith("The data contradict the prior of level, ")
        assert "dtprob diagnose" in text
    (text,) = warned(*of_skewed(0.0, 0.3, turn=2.5))
    assert text.startswith("The data contradict the prior of turn, ")
    assert warned(*of_skewed(1.5, 0.8)) == []


def test_of_many_entries_one_in_a_thousand_contradicts_nothing():
    shift = np.array([3.3])
    one = Learnt(np.zeros(1), shift, np.ones(1))
    assert one.contradicts(1).all()
    assert not one.contradicts(1000).any()


def test_chains_in_two_modes_say_nothing_of_a_prior():
    random = np.random.default_rng(2)
    idle = random.normal(size=SHAPE) + np.array([-6.0, -6.0, 6.0, 6.0])[:, None]
    posterior = Posterior(draws={"idle": idle}, latent=("idle",))
    values = learnt(posterior, line, {"x": jnp.zeros(3), "y": jnp.zeros(3)}, ["idle"])
    assert warned(posterior, values) == []
    assert "The chains disagree on idle" in summarise(posterior, values)["warnings"][0]
