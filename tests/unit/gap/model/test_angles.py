"""Phases that are drawn uniformly from a whole turn have no edge for a fit to stick at."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.diagnose import diagnose
from dtprob.gap.model.angles import unrolled
from dtprob.gap.model.problem import Problem
from dtprob.inference import Laplace

USERS, SLOTS = 30, 24


def phases(low, turn):
    """Phases of users, each with its own start and frequency; of the start only a share of a turn counts."""

    def model(time, antenna, y=None):
        frequency = numpyro.sample("frequency", dist.Normal(40.0, 10.0))
        sharpness = numpyro.sample("sharpness", dist.LogNormal(2.0, 1.0))
        with numpyro.plate("user", USERS, dim=-2):
            start = numpyro.sample("start", dist.Uniform(low, low + 2 * jnp.pi))
            own = numpyro.sample("own", dist.Normal(0.0, 1.0))
            with numpyro.plate("slot", SLOTS, dim=-1):
                turned = turn * start + 2 * jnp.pi * (frequency + 3 * own) * time
                phase = numpyro.deterministic("phase", turned)
                numpyro.sample("y", dist.VonMises(phase, sharpness), obs=y)

    return model


ANTENNA = Effect(
    "antenna",
    {"phase": lambda phase, p, context: phase + p["shift"] * context["antenna"]},
    (Parameter("shift", dist.Normal(0.0, 0.5), unit="rad"),),
)


def readings(shift, seed):
    """By NumPy alone."""
    rng = np.random.default_rng(seed)
    time = np.broadcast_to(np.arange(SLOTS) * 1e-3, (USERS, SLOTS)).copy()
    antenna = rng.integers(0, 2, (USERS, SLOTS))
    own = 37 + 3 * rng.standard_normal((USERS, 1))
    y = rng.uniform(-np.pi, np.pi, (USERS, 1)) + 2 * np.pi * own * time + shift * antenna
    y = y + rng.vonmises(0, 8.0, (USERS, SLOTS))
    return {"time": time, "antenna": antenna, "y": (y + np.pi) % (2 * np.pi) - np.pi}


@pytest.mark.parametrize("low", [-np.pi, 0.0])
def test_a_phase_of_a_whole_turn_has_no_edge(low):
    problem = Problem(phases(low, 1.0), readings(0.0, 0), (ANTENNA,))
    assert problem.declaration.latent["start"].is_circular
    assert problem.declaration.latent["start"].shape == (USERS, 1)
    assert problem.own.keys() == {"start", "own"}


def test_what_changes_across_a_turn_keeps_its_edge():
    model = phases(-np.pi, 0.4)
    assert unrolled(model, readings(0.0, 0)) is model


@pytest.mark.study
@pytest.mark.parametrize("shift", [0.0, 0.25])
def test_phases_all_round_the_circle(shift):
    """Of the right twin a fit had no finite likelihood, or users stuck at an end were a gap."""
    found = diagnose(
        phases(-np.pi, 1.0),
        readings(shift, 1),
        (ANTENNA,),
        key=jax.random.key(1),
        engine=Laplace(draws=300),
    )
    assert found.verdict == ("LISTED" if shift else "NO_GAP")
    assert [c.effects for c in found.causes] == ([("antenna",)] if shift else [])
