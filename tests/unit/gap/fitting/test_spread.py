"""Fits beside a random field whose spread is found with them, where steps fail, curvatures differ or the field vanishes."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.density import curved, system_at
from dtprob.gap.model.problem import Problem

LINKS, TAPS, GROUPS = 10, 20, 4
EXTRA = Effect(
    "extra",
    {"time": lambda value, p, context: value + p["scale"] * p[FIELD][context["group"]]},
    (Parameter("scale", dist.HalfNormal(1.0)),),
    kind="variance",
    field_shape=lambda value, context: (GROUPS,),
)


def taps(delay, group, y=None):
    """Powers of a link's taps: nothing before it arrives, then a decay; each arrives late by some time of its own."""
    floor, decay = (
        numpyro.sample("floor", dist.LogNormal(-3.0, 0.5)),
        numpyro.sample("decay", dist.LogNormal(0.0, 0.5)),
    )
    with numpyro.plate("link", LINKS):
        late = numpyro.sample("late", dist.StudentT(3.0, 0.0, 0.3))
        gain = numpyro.sample("gain", dist.Normal(0.0, 1.0))
    time = numpyro.deterministic("time", delay)
    since = jnp.arange(TAPS) / 4.0 - (time + late)[:, None]
    arrived = jax.nn.sigmoid(8.0 * since) * jnp.exp(-jnp.maximum(since, 0.0) / decay)
    power = floor + jnp.exp(gain)[:, None] * arrived
    with numpyro.plate("link", LINKS, dim=-2), numpyro.plate("tap", TAPS, dim=-1):
        numpyro.sample("y", dist.Gamma(1.5, 1.5 / power), obs=y)


def received(seed):
    """Taps of links in four groups, of which all links of one may be late by the same."""
    rng = np.random.default_rng(seed)
    delay, group = rng.uniform(0.5, 2.5, LINKS), rng.integers(0, GROUPS, LINKS)
    since = (
        np.arange(TAPS) / 4.0 - (delay + rng.normal(size=GROUPS)[group] * rng.choice([0, 0.2, 1.0]))[:, None]
    )
    strength = np.exp(rng.normal(size=LINKS))[:, None]
    power = 0.1 + strength * (since > 0) * np.exp(-np.maximum(since, 0) / rng.uniform(0.5, 2))
    y = power * rng.gamma(1.0, 1.0, size=power.shape) + 1e-3
    problem = Problem(
        taps, {"delay": jnp.asarray(delay), "group": jnp.asarray(group), "y": jnp.asarray(y)}, [EXTRA]
    )
    return problem.with_live(["extra"])


@pytest.fixture
def made(monkeypatch):
    """One entry for each set of curvatures that is made."""
    made = []
    monkeypatch.setattr(fitting, "system_at", lambda *given: made.append(1) or system_at(*given))
    return made


def fitted(problem):
    return fitting.fit(problem, problem.null(), ["extra"], spread={"extra": 1.0}, tolerance=0.03)


def test_a_step_that_fails_is_tried_shorter_while_the_spread_changes(made):
    """Tried again from the same damping it failed 32 times, 24 nats below the mode, as the spread went to and fro."""
    found = fitted(received(12))
    assert found.converged
    assert found.log_posterior > 45.0
    assert len(made) < 20


@pytest.mark.parametrize("seed", [25, 41, 68])
def test_a_step_that_fails_is_tried_shorter_until_it_is_negligible(seed):
    """Eight tries from a small damping were all; other starts showed 6 to 13 nats more."""
    problem = received(seed)
    found = fitted(problem)
    again = fitting.fit(problem, found.x, ["extra"], spread=found.spread, tolerance=0.03)
    assert found.converged
    assert again.log_posterior < found.log_posterior + 0.1


def test_a_spread_follows_one_kind_of_curvature(made, monkeypatch):
    """By those of Gauss and Newton and by the exact ones in turn it goes to and fro."""
    exact = []
    monkeypatch.setattr(fitting, "curved", lambda *given: exact.append(1) or curved(*given))
    found = fitted(received(46))
    assert found.converged
    assert len(exact) > 0
    assert len(made) < 20


def test_a_field_that_vanishes_does_so_at_once(made):
    found = fitted(received(1))
    assert found.converged
    assert found.spread["extra"] == pytest.approx(1e-9)
    assert len(made) < 16
