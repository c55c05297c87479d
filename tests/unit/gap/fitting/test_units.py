"""Fits in seconds and in nanoseconds are the same."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.base import fit_base
from dtprob.gap.fitting.centred import per_unit
from dtprob.gap.fitting.fit import fit
from dtprob.gap.fitting.known import _heavy_tailed
from dtprob.gap.fitting.refit import refit
from dtprob.gap.model.problem import Problem

LINKS, READINGS = 40, 8


def test_tangents_per_unit_know_no_units():
    own = np.random.default_rng(0).normal(size=(3, 10, 2))
    scale = np.array([1.0, 1e9])
    np.testing.assert_allclose(per_unit(own * scale) * scale, per_unit(own), rtol=1e-9)
    still = np.concatenate([own, np.zeros((3, 10, 1))], axis=-1)
    np.testing.assert_allclose(per_unit(still)[..., :2], per_unit(own), rtol=1e-9)
    assert not per_unit(still)[..., 2].any()


def arrivals(unit):
    """Arrival times about known distances, a common offset unknown, in seconds times a unit."""

    def timed(flight, toa=None):
        offset = numpyro.sample("offset", dist.Normal(0.0, 20e-9 * unit))
        with numpyro.plate("link", LINKS, dim=-2), numpyro.plate("reading", READINGS, dim=-1):
            time = numpyro.deterministic("time", flight + offset)
            numpyro.sample("toa", dist.Normal(time, 1e-9 * unit), obs=toa)

    return timed


def jitter(unit):
    return Effect(
        "jitter",
        {"time": lambda value, p, context: value + p["scale"] * p[FIELD]},
        (Parameter("scale", dist.HalfNormal(3e-9 * unit), unit="s"),),
        kind="variance",
        field_shape=lambda value, context: (value.shape[0], 1),
    )


@pytest.mark.study
@pytest.mark.parametrize("true", [1.0, 0.3, 0.0])
def test_a_spread_of_less_than_a_nanosecond_is_found(true):
    rng = np.random.default_rng(0)
    flight = rng.uniform(5, 50, (LINKS, READINGS)) / 3e8
    toa = flight + 1e-9 * (true * rng.normal(size=(LINKS, 1)) + rng.normal(size=(LINKS, READINGS)))
    found = []
    for unit in (1.0, 1e9):
        given = {"flight": jnp.asarray(flight * unit), "toa": jnp.asarray(toa * unit)}
        problem = Problem(arrivals(unit), given, [jitter(unit)])
        base = fit_base(problem, jax.random.key(0))
        wider = problem.with_live(["jitter"])
        before = fit(wider, wider.translate(base.x, problem))
        one = refit(wider, before, wider.effects[0], [])
        found.append((one.spread["jitter"] / unit * 1e9, one.log_evidence - before.log_evidence))
    (spread, gain), (same_spread, same_gain) = found
    assert spread == pytest.approx(same_spread, rel=0.02, abs=1e-6)
    assert gain == pytest.approx(same_gain, abs=0.02)
    assert spread == pytest.approx(true, abs=0.25)


def test_a_heavy_tail_is_away_from_its_centre_in_any_unit():
    for unit in (1e-9, 1.0):

        def clocks(toa=None, unit=unit):
            with numpyro.plate("link", 5):
                clock = numpyro.sample("clock", dist.StudentT(3.0, 0.0, unit))
            with numpyro.plate("link", 5, dim=-2), numpyro.plate("reading", 4, dim=-1):
                numpyro.sample("toa", dist.Normal(clock[:, None] * jnp.ones((5, 4)), unit), obs=toa)

        problem = Problem(clocks, {"toa": jnp.ones((5, 4)) * unit}, [])
        x = np.full(problem.dimension, 2.0 * unit)
        slope = problem.compiled.prior(x, np.eye(5))[0]
        precision = _heavy_tailed(problem, activate(problem), x, np.eye(5), slope=slope)
        np.testing.assert_allclose(precision * unit**2, 4.0 / (3.0 + 4.0), rtol=1e-6)  # (n + 1) / (n + x^2)
