"""The search takes back a first choice that was made for two effects at once, and finds what no listed effect explains."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects import Effect, Parameter
from dtprob.effects.effect import FIELD
from dtprob.gap.fitting.base import fit_base
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.which.search import search

LENGTH = 480
SETTINGS = Settings(replicates=200, candidates=3)


def table(x, street, y=None):
    """A constant level with unknown noise over rows that lie in streets."""
    del street
    level = numpyro.sample("level", dist.Normal(0.0, 3.0))
    noise = numpyro.sample("noise", dist.LogNormal(0.0, 0.5))
    with numpyro.plate("row", len(x)):
        mean = numpyro.deterministic("mean", level + 0.0 * x)
        numpyro.sample("y", dist.Normal(mean, noise), obs=y)


def wave(name, *parts):
    """An effect that adds its size times a sum of sines of x."""

    def rewrite(value, p, context):
        return value + p["c"] * sum(a * jnp.sin(f * context["x"]) for a, f in parts)

    return Effect(name, {"mean": rewrite}, (Parameter("c", dist.Normal(0.0, 1.0)),))


EFFECTS = (wave("one", (1.0, 3.0)), wave("two", (1.0, 5.0)), wave("both", (1.0, 3.0), (1.0, 5.0), (0.5, 9.0)))


def turning(name):
    """A sine of unknown frequency, whose slope at its null may point the wrong way."""

    def rewrite(value, p, context):
        return value + 1.2 * jnp.sin(p["frequency"] * context["x"])

    return Effect(name, {"mean": rewrite}, (Parameter("frequency", dist.HalfNormal(3.0)),))


def far(name):
    """An effect of some streets."""
    return Effect(
        name,
        {"mean": lambda value, p, context: value + p["c"] * (context["street"] < 8)},
        (Parameter("c", dist.Normal(0.0, 1.0)),),
    )


def rows(seed, shift=lambda x: 0.0 * x, spread=lambda street: 1.0 + 0.0 * street):
    rng = np.random.default_rng((seed, 5))
    x, street = rng.uniform(-np.pi, np.pi, LENGTH), rng.integers(0, 24, LENGTH)
    y = 1.0 + shift(x) + spread(street) * rng.normal(size=LENGTH)
    return {"x": jnp.asarray(x), "street": jnp.asarray(street), "y": jnp.asarray(y)}


def look(data, seed):
    """The steps of a search."""
    problem, key = Problem(table, data, EFFECTS, "street"), jax.random.key(seed)
    return search(problem, fit_base(problem, key), key, SETTINGS, print).steps


@pytest.mark.study
@pytest.mark.parametrize("seed", [0, 1])
def test_a_first_choice_made_for_two_effects_is_taken_back(seed):
    steps = look(rows(seed, shift=lambda x: 0.9 * np.sin(3 * x) + 0.6 * np.sin(5 * x)), seed)
    assert steps[0].accepted == "both"
    assert set(steps[-1].view.fitted.effects) == {"one", "two"}
    for step in (
        *steps,
        replace(steps[0], accepted=None),
    ):  # without an effect the trials' coordinates are not the fit's
        assert step.end.fitted.x.shape == (step.end.problem.dimension,)


def test_noise_that_differs_by_a_column_is_noticed():
    steps = look(rows(3, spread=lambda street: np.where(street < 4, 2.0, 1.0)), 3)
    assert steps[-1].view.fitted.effects == ()
    best = steps[-1].view.location.sites[0]
    assert (best.site, best.family) == ("y", "spread, by street")
    assert best.p_value < 1e-4


def scattered(x, street, district, y=None):
    """A constant level under noise of a known size, in streets of four districts."""
    del street, district
    level = numpyro.sample("level", dist.Normal(0.0, 3.0))
    with numpyro.plate("row", len(x)):
        deviation = numpyro.deterministic("deviation", 1.0 + 0.0 * x)
        numpyro.sample("y", dist.Normal(level, deviation), obs=y)


def apart(value, p, context):
    """Districts against the first one."""
    return value * jnp.exp(jnp.concatenate([jnp.zeros(1), p["c"]])[context["district"]])


LOUDER = (
    Effect(
        "louder",
        {"deviation": lambda value, p, _: value * jnp.exp(p["c"])},
        (Parameter("c", dist.Normal(0.0, 0.3)),),
    ),
    Effect("apart", {"deviation": apart}, (Parameter("c", dist.Normal(0.0, 0.15).expand([3]).to_event(1)),)),
)


@pytest.mark.study
@pytest.mark.parametrize("seed", range(2))
def test_a_family_that_says_the_same_in_another_form_takes_nothing_back(seed):
    """Four deviations by two effects or by the site: the likelihood is one, but the effects' priors are narrower."""
    data = rows(seed, spread=lambda street: np.exp(np.array([0.5, 0.7, 0.9, 1.1]))[street % 4])
    data |= {"district": data["street"] % 4}
    problem, key = Problem(scattered, data, LOUDER, "street"), jax.random.key(seed)
    end = search(problem, fit_base(problem, key), key, SETTINGS, print).steps[-1]
    assert set(end.view.fitted.effects) == {"louder", "apart"}


@pytest.mark.study
def test_nothing_is_found_where_there_is_nothing():
    """Four diagnoses at a level of 1%: one alarm has probability .04, two .0006."""
    assert sum(look(rows(10 + s), s)[0].view.alarmed(SETTINGS) for s in range(4)) <= 1


def test_an_effect_whose_slope_at_its_null_misleads_is_found_beside_another():
    data = rows(3)
    x, street = data["x"], data["street"]
    data["y"] += 4.0 * (street < 8) + 1.2 * jnp.sin(4.0 * x)
    problem, key = Problem(table, data, (turning("turn"), far("step")), "street"), jax.random.key(3)
    steps = search(problem, fit_base(problem, key), key, SETTINGS, print).steps
    assert steps[0].accepted == "step"
    assert set(steps[-1].view.fitted.effects) == {"step", "turn"}


WAVES = np.arange(1, 13)
MAP = Effect(
    "map",
    {
        "mean": lambda value, p, context: (
            value + p["scale"] * jnp.sin(jnp.outer(context["x"], WAVES)) @ p[FIELD]
        )
    },
    (Parameter("scale", dist.HalfNormal(1.0)),),
    kind="variance",
    field_shape=lambda value, context: (len(WAVES),),
)


def test_what_a_random_field_imitates_is_found_beside_it():
    """The field was chosen first, takes up all of it, and leaves nothing to see of the other."""
    weights = 0.35 * np.random.default_rng((1, 9)).normal(size=len(WAVES))
    data = rows(1, shift=lambda x: 1.6 * np.sin(3 * x) + np.sin(np.outer(x, WAVES)) @ weights)
    problem, key = Problem(table, data, (*EFFECTS[:2], MAP), "street"), jax.random.key(1)
    found = search(problem, fit_base(problem, key), key, SETTINGS, print)
    assert found.steps[0].accepted == "map"
    assert set(found.steps[-1].view.fitted.effects) == {"one", "map"}
    assert ("map",) in [rival.fitted.effects for rival in found.rivals]
