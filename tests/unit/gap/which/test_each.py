"""Entries of a random field wavelengths away from the null, found cluster by cluster."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.base import fit_base
from dtprob.gap.fitting.refit import refit
from dtprob.gap.model.problem import Problem
from dtprob.gap.which import entries
from dtprob.gap.which.each import scan_each
from dtprob.models.declaration import model

WAVE = 0.1
BEACONS = np.random.default_rng(0).uniform(-30.0, 30.0, (24, 2))


@model(axes={"place": ("receiver", "axis"), "signal": ("receiver", "beacon", "part")}, cluster="receiver")
def beacons(recorded, synchronised, seen=None):
    """Carriers of beacons, received at recorded places; their common gain and the noise are unknown.

    Receivers that are not synchronised have a phase of their own.
    """
    gain = numpyro.sample("gain", dist.LogNormal(0.0, 0.5))
    noise = numpyro.sample("noise", dist.LogNormal(jnp.log(0.3), 0.5))
    place = numpyro.deterministic("place", recorded)
    distance = jnp.linalg.norm(place[:, None] - BEACONS, axis=-1)
    phase = 2 * jnp.pi * distance / WAVE
    if not synchronised:
        with numpyro.plate("receiver", len(recorded)):
            phase = phase + numpyro.sample("phase", dist.VonMises(0.0, 1e-3))[:, None]
    with numpyro.plate("receiver", len(recorded), dim=-3):
        parts = jnp.stack([jnp.cos(phase), jnp.sin(phase)], -1)
        numpyro.sample("signal", dist.Normal(gain * parts, noise), obs=seen)


EACH = Effect(
    "misplaced",
    {"place": lambda value, p, context: value + p["scale"] * p[FIELD]},
    (Parameter("scale", dist.HalfNormal(0.1), unit="m"),),
    kind="variance",
    field_shape=lambda value, context: value.shape,
)

ALL = Effect(
    "misplaced",
    {"place": lambda value, p, context: value + p["displacement"]},
    (Parameter("displacement", dist.Normal(0.0, 0.1).expand((2,)), unit="m"),),
    instance="all",
)
FIRST = replace(
    ALL,
    rewrites={"place": lambda value, p, context: value.at[:6].add(p["displacement"])},
    instance="first_six",
)
TURNED = replace(
    ALL,
    rewrites={"place": lambda value, p, context: value + p["displacement"] * value[:, ::-1] / 10.0},
    instance="turned",
)


def received(moved, synchronised=True):
    """The problem of receivers that stand away from where they were recorded (receiver, axis), and its base fit."""
    rng = np.random.default_rng(4)
    recorded = rng.uniform(-10.0, 20.0, moved.shape)
    phase = 2 * np.pi * np.linalg.norm((recorded + moved)[:, None] - BEACONS, axis=-1) / WAVE
    phase += 0.0 if synchronised else rng.uniform(-np.pi, np.pi, (len(moved), 1))
    seen = np.stack([np.cos(phase), np.sin(phase)], -1) + 0.2 * rng.normal(size=(*phase.shape, 2))
    data = {"recorded": jnp.asarray(recorded), "synchronised": synchronised, "seen": jnp.asarray(seen)}
    problem = Problem(beacons, data, [EACH, ALL, FIRST, TURNED])
    return problem, fit_base(problem, jax.random.key(0))


def refitted(problem, base, found):
    """The field where a refit from what was found ends."""
    wider = problem.with_live([EACH.name])
    start = wider.translate(found.x, problem)
    index = wider.field_of(EACH).index
    start[index] = found.parameters
    before = fitting.fit(wider, wider.translate(base.x, problem))
    return refit(wider, before, EACH, [start]).x[index]


@pytest.mark.study
def test_one_misplaced_receiver_is_found_and_no_other_is_moved():
    moved = np.zeros((14, 2))
    moved[5] = 0.13, -0.21
    problem, base = received(moved)
    found = scan_each(problem, base.x, [EACH.name])[EACH.name]
    assert found.gain > 20.0
    assert np.flatnonzero(np.abs(found.parameters).sum(1)).tolist() == [5]
    np.testing.assert_allclose(refitted(problem, base, found), moved, atol=0.02)


@pytest.mark.parametrize("synchronised", [True, pytest.param(False, marks=pytest.mark.study)])
def test_receivers_that_all_stand_wavelengths_away_are_found(synchronised):
    moved = np.random.default_rng(1).normal(0.0, 0.1, (14, 2))
    problem, base = received(moved, synchronised)
    found = scan_each(problem, base.x, [EACH.name])[EACH.name]
    np.testing.assert_allclose(refitted(problem, base, found), moved, atol=0.02)


@pytest.mark.parametrize("synchronised", [True, pytest.param(False, marks=pytest.mark.study)])
@pytest.mark.parametrize(("effect", "touched"), [(ALL, 14), (FIRST, 6)])
def test_what_several_receivers_share_is_found_in_place_of_a_field(effect, touched, synchronised):
    moved = np.zeros((14, 2))
    moved[:touched] = 0.13, -0.21
    problem, base = received(moved, synchronised)
    found = scan_each(problem, base.x, [EACH.name, ALL.name, FIRST.name, TURNED.name])
    assert EACH.name not in found
    assert max(found, key=lambda name: found[name].gain) == effect.name
    np.testing.assert_allclose(found[effect.name].parameters, [0.13, -0.21], atol=0.02)


def test_what_is_far_along_one_axis_is_found_where_combinations_do_not_reach(monkeypatch):
    """With so few trials they end at 5 cm; antennas stand 27 cm higher."""
    monkeypatch.setattr(entries, "_TRIALS", 300)
    moved = np.zeros((14, 2))
    moved[:, 1] = 0.27
    problem, base = received(moved)
    found = scan_each(problem, base.x, [EACH.name, ALL.name])
    np.testing.assert_allclose(found[ALL.name].parameters, [0.0, 0.27], atol=0.02)


def test_the_best_turn_is_told_by_a_few_where_terms_are_a_cosine():
    turns = np.linspace(-np.pi, np.pi, 8, endpoint=False)[:, None, None]
    shift, size = np.random.default_rng(0).uniform([-3.0, 5.0], [3.0, 5e4], (4, 6, 2)).transpose(2, 0, 1)
    cosine = 7.0 + size * np.cos(turns - shift)
    highest, turn = entries._best_turn(cosine, turns.ravel())
    np.testing.assert_allclose(highest, 7.0 + size, rtol=1e-9)
    np.testing.assert_allclose(turn, shift, atol=1e-9)
    for other in (cosine + 0.1 * size * np.cos(2 * turns), np.where(turns == 0.0, -np.inf, cosine)):
        highest, turn = entries._best_turn(other, turns.ravel())
        np.testing.assert_allclose(highest, other.max(axis=0))
        np.testing.assert_allclose(turn, turns.ravel()[other.argmax(axis=0)])


def test_what_moves_receivers_each_by_something_else_is_no_field_with_entries_in_common():
    moved = np.random.default_rng(1).normal(0.0, 0.1, (14, 2))
    problem, base = received(moved)
    found = scan_each(problem, base.x, [EACH.name, ALL.name, TURNED.name])
    assert TURNED.name not in found
    assert EACH.name in found


@pytest.mark.study
@pytest.mark.parametrize("seed", range(3))
def test_where_no_receiver_has_moved_far_there_is_nothing_to_start_from(seed):
    """A start of nothing would be a field without a spread."""
    problem, base = received(1e-3 * np.random.default_rng(seed).normal(size=(14, 2)))
    assert scan_each(problem, base.x, [EACH.name]) == {}
