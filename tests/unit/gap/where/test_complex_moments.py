"""Noise of complex channels that remembers, has tails, or is not circular: noticed and named, silent where it is right."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.bootstrap import more, replicate
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.where.bounded import complex_tails
from dtprob.gap.where.family_test import family_test
from dtprob.gap.where.locate import locate
from dtprob.gap.where.moments import further_moments
from dtprob.models.complex_normal import ComplexNormal
from dtprob.models.declaration import model

SHAPE = (30, 12, 2)
AXES = ("link", "subcarrier", "antenna")


@model(cluster="link", axes={"expected": AXES, "channel": AXES})
def flat(steering, channel=None):
    """One path of unknown complex gain, in noise of unknown power."""
    gain = numpyro.sample("gain", dist.Normal(0.0, 10.0).expand([2]).to_event(1))
    noise = numpyro.sample("noise", dist.LogNormal(0.0, 1.0))
    expected = numpyro.deterministic("expected", (gain[0] + 1j * gain[1]) * steering)
    with contextlib.ExitStack() as stack:
        for i, (axis, n) in enumerate(zip(AXES, SHAPE, strict=True)):
            stack.enter_context(numpyro.plate(axis, n, dim=i - 3))
        numpyro.sample("channel", ComplexNormal(expected, noise), obs=channel)


def circular(rng):
    return (rng.normal(size=SHAPE) + 1j * rng.normal(size=SHAPE)) / np.sqrt(2)


def coloured(rng):
    """Each subcarrier a third of the one before, a quarter turn later."""
    noise = circular(rng)
    for k in range(1, SHAPE[1]):
        noise[:, k] = 0.3j * noise[:, k - 1] + np.sqrt(1 - 0.3**2) * noise[:, k]
    return noise


def coupled(rng):
    noise = circular(rng)
    noise[..., 1] = 0.3 * noise[..., 0] + np.sqrt(1 - 0.3**2) * noise[..., 1]
    return noise


def heavy(rng):
    noise = circular(rng)
    return noise * np.sqrt(3 / rng.chisquare(5, size=SHAPE))


def imbalanced(rng):
    """One part stronger than the other."""
    noise = circular(rng)
    return np.sqrt(1.3) * noise.real + 1j * np.sqrt(0.7) * noise.imag


def replicated(noise, seed=3):
    rng = np.random.default_rng(seed)
    steering = np.exp(1j * rng.uniform(0, 2 * np.pi, SHAPE))
    data = {"steering": steering, "channel": (1 + 2j) * steering + 0.5 * noise(rng)}
    problem = Problem(flat, {name: jnp.asarray(value) for name, value in data.items()}, [])
    fitted = fitting.fit(problem, problem.null())
    projection, settings = project(problem, fitted), Settings()
    return (
        problem,
        fitted,
        projection,
        replicate(problem, fitted, projection, jax.random.key(0), settings),
        settings,
    )


@pytest.mark.parametrize(
    ("noise", "expected"),
    [
        (coloured, "dependence along subcarrier"),
        (coupled, "dependence from antenna to antenna"),
        pytest.param(heavy, "tails", marks=pytest.mark.study),  # not the spread of the farthest entries
        (imbalanced, "circularity"),
    ],
)
def test_what_is_wrong_with_complex_noise_is_named(noise, expected):
    first = locate(*replicated(noise)).sites[0]
    assert (first.site, first.moment) == ("channel", expected)
    assert first.p_value < 1e-4
    assert not first.last


@pytest.mark.study
def test_nothing_is_noticed_where_nothing_is_wrong():
    """Each of 150 other replicates taken as the data: no more small p-values than chance lets there be."""
    problem, fitted, _, drawn, _ = replicated(circular)
    rows = more(drawn, 4).rows[1:]
    null, data = rows[:99], rows[99:249]
    found = {}
    for row in data:
        for name, family, scores in further_moments(problem, fitted.x, np.concatenate([row[None], null])):
            found.setdefault((name, family.label), []).append(family_test(family, scores).p_value)
    assert len(found) == 5 * 4 - 1 + 1  # no map over the one pair of antennas; tails of a few
    for values in found.values():
        assert len(values) == 150
        for level in (0.01, 0.1):
            assert (np.array(values) <= level).sum() <= stats.binom.isf(1e-3 / len(found), 150, 1.3 * level)


def test_a_change_of_power_does_not_move_the_tails():
    power = np.linspace(0, 60, 1_000_001)
    weight = np.exp(-power) * power[1]
    weight[0] /= 2
    row = np.sqrt(2 * power) + 0j
    assert abs(np.sum(weight * complex_tails(row))) < 1e-6
    assert abs(np.sum(weight * power * complex_tails(row))) < 1e-6


def test_heavy_tails_have_the_sign_that_they_say():
    rng = np.random.default_rng(4)
    noise = np.sqrt(2) * circular(rng)
    assert abs(complex_tails(noise).mean()) < 0.1
    assert complex_tails(noise * np.sqrt(3 / rng.chisquare(5, size=SHAPE))).mean() > 0.05
