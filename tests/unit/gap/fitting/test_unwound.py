"""Phases that go on for more than a turn are fitted in the turn that they are in, not in the nearest one."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.contrib.control_flow import scan
from numpyro.handlers import mask

from dtprob.gap.fitting.integrated import based
from dtprob.gap.fitting.unwound import unwound
from dtprob.gap.model.problem import Problem
from dtprob.models.declaration import model

SLOTS, PACKETS, NOISE = 40, 6, 0.2


@model(cluster="packet", axes={"seen": ("slot", "packet"), "phase": ("slot", "packet")})
def tracked(first, known, seen=None):
    """A walk of each packet's phase."""

    def step(phase, at):
        reading, counts = at
        with numpyro.plate("packet", PACKETS):
            phase = numpyro.deterministic("phase", phase + 0.2 * numpyro.sample("z", dist.Normal(0.0, 1.0)))
            with mask(mask=counts):
                numpyro.sample("seen", dist.VonMises(phase, NOISE**-2 * jnp.ones(PACKETS)), obs=reading)
        return phase, None

    numpyro.sample("spare", dist.Normal(0.0, 1.0))
    scan(step, first, (seen, known), length=SLOTS)


@model(cluster="window")
def drifting(time, window, seen=None):
    """One oscillator, looked at in windows of time."""
    rate = numpyro.sample("rate", dist.Normal(0.0, 0.5))
    bend = numpyro.sample("bend", dist.Normal(0.0, 0.02))
    phase = numpyro.deterministic("phase", rate * time + bend * time**2)
    with numpyro.plate("reading", len(time)):
        numpyro.sample("seen", dist.VonMises(phase, NOISE**-2), obs=seen)


def wrapped(phase):
    return (phase + np.pi) % (2 * np.pi) - np.pi


def walks(rate=0.15):
    rng = np.random.default_rng(0)
    first = rng.uniform(-np.pi, np.pi, PACKETS)
    phase = first + np.cumsum(rng.normal(rate, 0.1, (SLOTS, PACKETS)), axis=0)
    known = rng.uniform(size=phase.shape) > 0.1
    seen = np.where(known, wrapped(phase + rng.normal(0, NOISE, phase.shape)), 3.0)
    return phase, {"first": first, "known": known, "seen": seen}


def test_a_walk_of_more_than_a_turn_is_followed():
    phase, data = walks()
    assert np.abs(phase[-1] - data["first"]).max() > 1.5 * np.pi
    problem = Problem(tracked, data, [])
    middle = problem.prior_spread.middle
    found = [problem.compiled.sites(x)["phase"] for x in unwound(problem, middle)]
    assert len(found) == 2
    for one in found:
        assert np.abs(one - phase).max() < 1.0
    start = based(problem, jax.random.key(0))
    assert np.abs(start.problem.compiled.sites(start.fitted.x)["phase"] - phase).max() < 1.0


def test_without_turns_counted_the_last_readings_are_in_a_wrong_one(monkeypatch):
    phase, data = walks()
    monkeypatch.setattr("dtprob.gap.fitting.integrated.unwound", lambda *_: [])
    start = based(Problem(tracked, data, []), jax.random.key(0))
    assert np.abs(start.problem.compiled.sites(start.fitted.x)["phase"] - phase).max() > np.pi


@pytest.mark.parametrize("rate", [0.4, -0.3])
def test_what_all_windows_share_is_followed_too(rate):
    rng = np.random.default_rng(1)
    time = np.arange(60.0)
    phase = rate * time + 0.01 * time**2
    data = {
        "time": time,
        "window": (time // 10).astype(int),
        "seen": wrapped(phase + rng.normal(0, NOISE, 60)),
    }
    problem = Problem(drifting, data, [], "window")
    found = [problem.compiled.sites(x)["phase"] for x in unwound(problem, problem.prior_spread.middle)]
    assert min(np.abs(one - phase).max() for one in found) < 1.0


def test_readings_that_do_not_go_on_and_those_of_one_turn_are_left_alone():
    _, data = walks()
    rng = np.random.default_rng(2)
    anywhere = {**data, "seen": rng.uniform(-np.pi, np.pi, data["seen"].shape)}
    near = {**data, "seen": wrapped(data["first"] + rng.normal(0, NOISE, data["seen"].shape))}
    for given in (anywhere, near):
        problem = Problem(tracked, given, [])
        assert unwound(problem, problem.prior_spread.middle) == []
