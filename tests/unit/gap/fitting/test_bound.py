"""An effect that data push below its null explains nothing, and hides nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.diagnose import diagnose
from dtprob.gap.fitting.bound import bound
from dtprob.gap.fitting.fit import fit
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.which.pairs import best_pairs
from dtprob.inference import Laplace

ROOMS, READINGS = 30, 8


def rooms(door, hour, y=None):
    level = numpyro.sample("level", dist.Normal(0.0, 5.0))
    slope = numpyro.sample("slope", dist.Normal(0.0, 5.0))
    mean = numpyro.deterministic("mean", level + slope * hour + 0.0 * door)
    with numpyro.plate("room", ROOMS, dim=-2), numpyro.plate("reading", READINGS, dim=-1):
        numpyro.sample("y", dist.Normal(mean, 0.5), obs=y)


def door(name, is_open):
    def rewrite(value, p, context):
        return value + p["gain"] * (context["door"] == is_open)

    return Effect(name, {"mean": rewrite}, (Parameter("gain", dist.HalfNormal(1.0)),))


CLOSED, OPEN = door("closed_door", 0), door("open_door", 1)


@pytest.fixture(scope="module")
def data():
    """Less where the door is open late in the day: a gain of closed doors explains a part, one of open doors nothing."""
    rng = np.random.default_rng(0)
    is_open, hour = rng.integers(0, 2, (ROOMS, READINGS)), rng.random((ROOMS, READINGS))
    y = 1 + hour - 0.8 * is_open * (hour > 0.5) + 0.5 * rng.normal(size=hour.shape)
    return {"door": jnp.asarray(is_open), "hour": jnp.asarray(hour), "y": jnp.asarray(y)}


def test_what_stands_at_its_null_is_bound_and_what_does_not_is_not(data):
    problem = Problem(rooms, data, [CLOSED, OPEN]).with_live(["closed_door", "open_door"])
    start = problem.null()
    start[problem.layout.of(OPEN)] = 0.1
    found = fit(problem, start, ["closed_door", "open_door"])
    assert bound(problem, found) == ("open_door",)
    assert bound(problem, fit(problem, problem.null(), ["closed_door"])) == ()


def test_no_pair_is_promised_below_a_null():
    """Scores ask for one more and one less; alone the first is worth as much as without the other."""
    information, score = np.array([[100.0, 60.0], [60.0, 100.0]]), np.array([60.0, -60.0])
    groups, price = (np.array([0]), np.array([1])), np.zeros(2)
    assert best_pairs((CLOSED, OPEN), groups, information, score, np.ones(2), price=price) == ()
    assert len(best_pairs((CLOSED, OPEN), groups, information, np.abs(score), np.ones(2), price=price)) == 1


@pytest.mark.study
def test_the_answer_is_that_without_it(data):
    """A candidate that points the wrong way was a partner, and took up what is left."""

    def answer(*effects):
        return diagnose(
            rooms,
            data,
            effects,
            key=jax.random.key(0),
            engine=Laplace(),
            settings=Settings(site_replicates=99),
        )

    with_it, without = answer(CLOSED, OPEN), answer(CLOSED)
    assert with_it.verdict == without.verdict
    assert [c.effects for c in with_it.causes] == [c.effects for c in without.causes] == [("closed_door",)]
