"""Clusters' own coordinates that only an angle and another one together free from a wrong optimum."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.effects import Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.base import fit_base
from dtprob.gap.fitting.marginal import marginal, settled
from dtprob.gap.fitting.refit import starting_points
from dtprob.gap.fitting.sweep import elsewhere, swept, turned
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.which.scan import centre, scan, scan_anew
from dtprob.models.complex_normal import ComplexNormal
from dtprob.models.declaration import model

FREQUENCY = np.linspace(8.0, 14.0, 12)
LATE = np.array([-1.6, -0.7, 0.0, 0.9, 1.7])
PHASE = np.array([0.3, -2.0, 1.0, 2.9, -0.6])
NOISE = 0.1
TAPS = np.linspace(-3.0, 3.0, 31)
PULSES, WEAKER = np.array([-0.6, 0.0, 1.0, 2.2]), 0.2
BEND = Effect(
    "bend", {"level": lambda value, p, _: value + p["by"]}, (Parameter("by", dist.Normal(0.0, 1.0)),)
)
LATER = Effect(
    "later",
    {"wave": lambda value, p, _: value * jnp.exp(-1j * p["by"] * FREQUENCY)},
    (Parameter("by", dist.Normal(0.0, 0.5)),),
)


@model(cluster="link", axes={"level": (), "wave": ("link", "tone")})
def delayed(links, y=None):
    """Tones far from zero frequency: a delay that is off turns their phase by whole circles."""
    level = numpyro.deterministic("level", numpyro.sample("scale", dist.Normal(1.0, 0.1)))
    with numpyro.plate("link", links, dim=-2):
        phase = numpyro.sample("phase", dist.VonMises(0.0, 1e-9))
        late = numpyro.sample("late", dist.Normal(0.0, 1.0))
        wave = numpyro.deterministic("wave", level * jnp.exp(1j * (phase - late * FREQUENCY)))
        with numpyro.plate("tone", len(FREQUENCY), dim=-1):
            numpyro.sample("y", ComplexNormal(wave, NOISE**2), obs=y)


@pytest.fixture(scope="module")
def problem():
    noise = jax.random.normal(jax.random.key(0), (2, len(LATE), len(FREQUENCY))) * NOISE / np.sqrt(2)
    wave = np.exp(1j * (PHASE[:, None] - LATE[:, None] * FREQUENCY))
    return Problem(
        delayed, {"links": len(LATE), "y": jnp.asarray(wave + noise[0] + 1j * noise[1])}, [BEND, LATER]
    )


def own(problem, x, name):
    return x[problem.layout[name].index[:, 0]]


def places(problem, x):
    return own(problem, x, "late")


def test_usual_places_are_those_of_the_prior(problem):
    centre, scale = problem.prior_spread.usual(problem.layout["late"].index)
    assert np.isclose(centre, 0.0, atol=0.1)
    assert np.isclose(scale, 1.0, atol=0.15)


def test_every_link_is_freed_from_its_wrong_basin(problem):
    start = problem.start({"scale": 1.0, "phase": np.zeros((5, 1)), "late": np.zeros((5, 1))})
    stuck = fitting.fit(problem, turned(problem, start, problem.compiled.by_cluster))
    assert np.abs(places(problem, stuck.x) - LATE).max() > 0.3
    free = settled(problem, stuck)
    np.testing.assert_allclose(places(problem, free.x), LATE, atol=0.06)
    assert free.log_posterior > stuck.log_posterior + 100
    assert settled(problem, free) is free
    based = fit_base(problem, jax.random.key(1), polished=0)
    np.testing.assert_allclose(places(problem, based.x), LATE, atol=0.06)


def test_a_link_that_was_left_out_is_judged_at_its_best(problem):
    free = fit_base(problem, jax.random.key(1), polished=0)
    moved = free.x.copy()
    moved[problem.layout["late"].index[0]] += 1.9
    away = marginal(problem, fitting.Fit(moved, *list(vars(free).values())[1:]))
    np.testing.assert_allclose(away, marginal(problem, free), atol=1e-2)


def test_a_sweep_keeps_what_is_best_and_what_is_shared(problem):
    free = fit_base(problem, jax.random.key(1), polished=0)
    found = swept(problem, free.x, problem.compiled.by_cluster)
    assert np.all(problem.compiled.by_cluster(found) >= problem.compiled.by_cluster(free.x))
    shared = problem.layout["scale"].index[0]
    np.testing.assert_array_equal(found[shared], free.x[shared])
    nowhere = swept(problem, free.x, lambda x: np.full(len(LATE), np.nan))
    np.testing.assert_array_equal(nowhere, free.x)


@model(cluster="link", axes={"power": ("link", "tap")})
def pulsed(links, y=None):
    """A narrow pulse over taps, far from which its place has no slope."""
    with numpyro.plate("link", links, dim=-2):
        late = numpyro.sample("late", dist.Normal(0.0, 1.0))
        power = numpyro.deterministic("power", jnp.exp(-0.5 * ((TAPS - late) / 0.2) ** 2))
        with numpyro.plate("tap", len(TAPS), dim=-1):
            numpyro.sample("y", dist.Normal(power, NOISE), obs=y)


def test_a_place_without_an_angle_is_looked_for_too():
    noise = NOISE * np.random.default_rng(3).normal(size=(len(LATE), len(TAPS)))
    power = np.exp(-0.5 * ((TAPS - LATE[:, None]) / 0.2) ** 2)
    problem = Problem(pulsed, {"links": len(LATE), "y": jnp.asarray(power + noise)}, [])
    stuck = fitting.fit(problem, problem.start({"late": np.zeros((5, 1))}))
    assert np.abs(places(problem, stuck.x) - LATE).max() > 0.3
    np.testing.assert_allclose(places(problem, settled(problem, stuck).x), LATE, atol=0.1)


def pulses_at(late, amplitude):
    """Pulses (link, tap) of these amplitudes, each link as late as it is (link, 1)."""
    apart = (TAPS - late)[..., None] - PULSES
    return jnp.exp(-0.5 * (apart / 0.2) ** 2) @ amplitude


@model(cluster="link", axes={"amplitude": ("pulse",), "power": ("link", "tap")})
def two_places(links, y=None):
    """Each link has two pulses of a strength of its own; those of another place could stand there instead."""
    amplitude = numpyro.deterministic("amplitude", jnp.array([1.0, 1.0, 0.0, 0.0]))
    with numpyro.plate("link", links, dim=-2):
        late = numpyro.sample("late", dist.Normal(0.0, 1.0))
        loud = numpyro.sample("loud", dist.Normal(0.0, 1.0))
        pulses = pulses_at(late, amplitude)
        power = numpyro.deterministic("power", jnp.exp(loud) * pulses)
        with numpyro.plate("tap", len(TAPS), dim=-1):
            numpyro.sample("y", dist.Normal(power, NOISE), obs=y)


def swap_size(name):
    return (Parameter(name, dist.Normal(0.0, 0.7)),)


def elsewhere_pulses(late, loud):
    """Pulses (link, tap) of the other place, which is weaker."""
    apart = TAPS - late[:, None] - PULSES[2:, None, None]
    return WEAKER * np.exp(loud)[:, None] * np.exp(-0.5 * (apart / 0.2) ** 2).sum(0)


@pytest.mark.study
def test_what_needs_the_links_found_anew_is_seen_by_the_scan():
    late, loud = LATE / 4, np.array([1.6, 1.8, 1.4, 1.7, 1.6])
    noise = NOISE * np.random.default_rng(4).normal(size=(len(late), len(TAPS)))
    power = elsewhere_pulses(late, loud)
    swap = Effect(
        "swap",
        {"amplitude": lambda value, p, _: value + p["share"] * (WEAKER * value[::-1] - value)},
        swap_size("share"),
    )
    nothing = Effect("nothing", {"amplitude": lambda value, p, _: value + 0 * p["by"]}, swap_size("by"))
    data = {"links": len(late), "y": jnp.asarray(power + noise)}
    problem = Problem(two_places, data, [swap, nothing])
    start = problem.start({"late": np.zeros((5, 1)), "loud": np.zeros((5, 1))})
    assert scan_anew(problem, start, ["nothing"]) == {}  # links found anew gain without it too
    fitted = settled(problem, fitting.fit(problem, start))
    assert np.abs(places(problem, fitted.x) - late).max() > 0.5
    assert np.abs(own(problem, fitted.x, "loud") - loud).min() > 1.5
    assert "swap" not in scan(problem, fitted.x, ["swap"])
    found = scan_anew(problem, fitted.x, ["swap"])["swap"]
    assert found.gain > 100
    assert np.isclose(found.parameters[0], 1.0)
    assert np.sum(np.abs(places(problem, found.x) - late) < 0.3) >= 4  # trial places are far apart
    there = places(problem, found.x), own(problem, found.x, "loud")
    rest = (np.asarray(problem.data["y"]) - elsewhere_pulses(*there)) / NOISE
    terms = stats.norm.logpdf(rest).sum(1) - len(TAPS) * np.log(NOISE)
    terms += stats.norm.logpdf(there).sum(0)
    by_cluster = problem.compiled.by_cluster
    unswapped = np.max(
        [by_cluster(fitted.x), *(t for _, t in elsewhere(problem, fitted.x, by_cluster))], axis=0
    )
    assert np.isclose(found.gain, terms.sum() - unswapped.sum(), rtol=1e-6)
    linear = Problem(levels, {"y": jnp.asarray(power)}, [])
    assert elsewhere(linear, linear.start({"level": np.zeros((5, 1))}), linear.compiled.by_cluster) == []


@model(cluster="link", axes={"amplitude": ("pulse",), "power": ("link", "tap")})
def silenced(links, y=None):
    """All pulses have a loudness and a spread of their own; one of noise is shared, too."""
    amplitude = numpyro.deterministic("amplitude", jnp.array([1.0, 1.0, 0.0, 0.0]))
    all_loud = numpyro.sample("all_loud", dist.Normal(0.0, 2.0))
    noise = numpyro.sample("noise", dist.LogNormal(0.0, 1.0))
    with numpyro.plate("link", links, dim=-2):
        late = numpyro.sample("late", dist.Normal(0.0, 1.0))
        pulses = pulses_at(late, amplitude)
        power = numpyro.deterministic("power", jnp.exp(all_loud) * pulses)
        with numpyro.plate("tap", len(TAPS), dim=-1):
            numpyro.sample("y", dist.Normal(power, noise), obs=y)


@pytest.mark.study
def test_what_the_fit_has_silenced_is_seen_about_the_priors_centre():
    late = LATE / 4
    noise = NOISE * np.random.default_rng(5).normal(size=(len(late), len(TAPS)))
    power = elsewhere_pulses(late, np.zeros(len(late))) / WEAKER
    swap = Effect(
        "swap",
        {"amplitude": lambda value, p, _: value + p["share"] * (value[::-1] - value)},
        swap_size("share"),
    )
    problem = Problem(silenced, {"links": len(late), "y": jnp.asarray(power + noise)}, [swap])
    start = {"late": np.zeros((5, 1)), "all_loud": np.array(-4.0), "noise": np.array(0.5)}
    x = fitting.fit(problem, problem.start(start)).x
    assert x[problem.layout["all_loud"].index[0]] < -2.0
    assert "swap" not in scan(problem, x, ["swap"])
    assert "swap" not in scan_anew(problem, x, ["swap"])
    found = scan_anew(problem, centre(problem, x), ["swap"])["swap"]
    assert found.gain > 20
    np.testing.assert_allclose(found.parameters, [1.0])


@model(cluster="link")
def levels(y=None):
    """A level for each link, with one optimum."""
    with numpyro.plate("link", len(LATE), dim=-2):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
        with numpyro.plate("tap", len(TAPS), dim=-1):
            numpyro.sample("y", dist.Normal(level, NOISE), obs=y)


def test_large_sizes_are_tried_with_the_links_found_anew(problem):
    free = fit_base(problem, jax.random.key(1), polished=0)
    wider = problem.with_live(["later"])
    x, index = wider.translate(free.x, problem), wider.layout["later.by"].index[0]
    starts = starting_points(wider, x, LATER, None, Settings(starts=2))
    large = [
        start
        for start in starts
        if np.abs(start[index]).item() >= 0.35 and np.any(places(wider, start) != places(wider, x))
    ]
    assert len(large) == 2
    for start in large:
        held = x.copy()
        held[index] = start[index]
        assert wider.compiled.by_cluster(start).sum() > wider.compiled.by_cluster(held).sum() + 100
