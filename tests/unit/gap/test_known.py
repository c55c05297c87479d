"""Effects that are known beforehand: unknowns of the base model, found past their local optima."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects import Effect, Parameter, with_effects
from dtprob.effects.rewriting import effects_of
from dtprob.gap.fitting.base import fit_base
from dtprob.gap.model.problem import Problem
from dtprob.models.declaration import model

WAVES = np.linspace(20.0, 40.0, 24)
PLACED = 0.12
SHIFT = Effect(
    "shift",
    {"place": lambda value, p, _: value + p["by"]},
    (Parameter("by", dist.Normal(0.0, 0.1), unit="m"),),
)
TILT = Effect(
    "tilt", {"wave": lambda value, p, _: value + p["by"]}, (Parameter("by", dist.Normal(0.0, 1.0)),)
)


@model(cluster="row")
def waves(number, y=None):
    """Waves of several lengths at one place, whose phase a shift turns by more than a full circle."""
    level = numpyro.sample("level", dist.Normal(0.0, 0.1))
    place = numpyro.deterministic("place", jnp.zeros(len(number)))
    wave = numpyro.deterministic("wave", level + jnp.cos(number * place) + jnp.sin(number * place))
    with numpyro.plate("row", len(number)):
        numpyro.sample("y", dist.Normal(wave, 0.1), obs=y)


def test_an_extended_model_says_its_effects():
    assert effects_of(waves) == ()
    extended = with_effects(with_effects(waves, [SHIFT]), [TILT])
    assert effects_of(extended) == (SHIFT, TILT)
    assert effects_of(functools.partial(extended, number=WAVES)) == (SHIFT, TILT)


@pytest.mark.parametrize("polished", [0, 1])
def test_a_known_effect_is_found_past_its_local_optima(polished):
    noise = 0.1 * np.asarray(jax.random.normal(jax.random.key(0), WAVES.shape))
    data = {"number": WAVES, "y": 0.1 + np.cos(WAVES * PLACED) + np.sin(WAVES * PLACED) + noise}
    problem = Problem(with_effects(waves, [SHIFT]), data, [TILT])
    fitted = fit_base(problem, jax.random.key(1), polished=polished)
    assert np.isclose(fitted.x[problem.layout["shift.by"].index].item(), PLACED, atol=0.01)
    assert fitted.effects == ()
    assert {b.name for b in problem.blocks_of(None)} == {"level", "shift.by"}
