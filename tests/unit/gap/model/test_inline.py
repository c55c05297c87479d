"""Readings whose values no named site stands for are looked at themselves; a site that is named and not used is none."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.gap.diagnose import diagnose
from dtprob.gap.model.inline import unnamed
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.inference import Laplace
from tests.unit.gap.examples import draw, hierarchy, line, logistic, spread

N = 200


def levels(named):
    """A model of a level, that names what `named` says."""

    def model(height, y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 5.0))
        scale = numpyro.sample("scale", dist.HalfNormal(2.0))
        mean = level + jnp.zeros(height.shape)
        if "used" in named:
            mean = numpyro.deterministic("mean", mean)
        if "unused" in named:
            numpyro.deterministic("mu", mean)
        if "variance" in named:
            numpyro.deterministic("variance", scale**2 + jnp.zeros(height.shape))
        if "level" in named:
            mean = numpyro.deterministic("of_all", level) + jnp.zeros(height.shape)
        with numpyro.plate("row", len(height)):
            numpyro.sample("y", dist.Normal(mean, scale), obs=y)

    return model


def data():
    rng = np.random.default_rng(0)
    height = rng.normal(size=N)
    return {"height": jnp.asarray(height), "y": jnp.asarray(1.5 * height + rng.normal(size=N))}


@pytest.mark.parametrize(
    ("named", "expected"),
    [
        ((), {"y"}),
        (("unused",), {"y"}),
        (("variance",), {"y"}),
        (("level",), {"y"}),
        (("used",), set()),
        (("used", "variance"), set()),
    ],
)
def test_a_site_stands_for_readings_that_it_moves_one_by_one(named, expected):
    problem = Problem(levels(named), data(), [])
    assert unnamed(problem, np.array([0.3, 0.1])) == expected


@pytest.mark.parametrize("model", [line, hierarchy, spread, logistic])
def test_sites_of_the_examples_stand_for_all_their_readings(model):
    problem = Problem(model, draw(model.__name__), [])
    assert unnamed(problem, np.full(problem.layout.dimension, 0.1)) == set()


@pytest.mark.parametrize("named", [("unused",), ("variance",)])
def test_a_law_is_found_whatever_else_is_named(named):
    settings = Settings(replicates=100, site_replicates=50)
    found = diagnose(levels(named), data(), [], key=jax.random.key(0), engine=Laplace(), settings=settings)
    assert found.verdict == "UNLISTED"
    site = found.sections["where"]["sites"][0]
    assert site["site"] == "y"
    assert "height" in site["family"]
    (note,) = (text for text in found.sections["fit"]["warnings"] if "moves the values of y" in text)
    assert note.endswith("what numpyro.deterministic returns")


def per_device(y=None):
    level = numpyro.sample("level", dist.Normal(0.0, 5.0))
    with numpyro.plate("device", 12, dim=-2):
        of_device = numpyro.deterministic("of_device", level + jnp.zeros((12, 1)))
        with numpyro.plate("reading", 20, dim=-1):
            numpyro.sample("y", dist.Normal(of_device, 1.0), obs=y)


@pytest.mark.parametrize(("wrong", "site"), [("a device", "of_device"), ("a drift", "y")])
def test_a_site_that_shows_it_as_well_is_named_before_the_readings(wrong, site):
    rng = np.random.default_rng(3)
    shift = 3.0 * (np.arange(12) == 4)[:, None] if wrong == "a device" else 1.5 * np.linspace(-1, 1, 20)
    given = {"y": jnp.asarray(rng.normal(size=(12, 20)) + shift)}
    settings = Settings(replicates=100, site_replicates=50)
    found = diagnose(per_device, given, [], key=jax.random.key(0), engine=Laplace(), settings=settings)
    assert found.verdict == "UNLISTED"
    assert found.sections["where"]["sites"][0]["site"] == site
    assert not any("moves the values" in text for text in found.sections["fit"]["warnings"])
