"""Sizes that first-order scores cannot see: an offset that turns phases, small beside what its prior allows."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.model.problem import Problem
from dtprob.gap.which.scan import scan


def waves(delay, seen=None):
    """Phases of paths, whose common gain is unknown."""
    gain = numpyro.sample("gain", dist.LogNormal(0.0, 0.5))
    with numpyro.plate("path", len(delay)):
        phase = numpyro.deterministic("phase", jnp.zeros(len(delay)))
        numpyro.sample("seen", dist.Normal(gain * jnp.cos(phase - 1.0), 0.1), obs=seen)


CARRIER = Effect(
    "carrier",
    {"phase": lambda value, p, context: value - 2 * jnp.pi * p["offset"] * context["delay"]},
    (Parameter("offset", dist.Normal(0.0, 350.0), unit="MHz"),),
)


@pytest.mark.parametrize("offset", [10.0, -23.0, 31.0])
def test_a_wrong_carrier_is_found_between_the_even_sizes(offset):
    """Delays of up to .2 us leave a basin of some MHz, and even sizes lie 11 MHz apart."""
    rng = np.random.default_rng(0)
    delay = rng.uniform(0.0, 0.2, 120)
    seen = np.cos(-2 * np.pi * offset * delay - 1.0) + 0.1 * rng.normal(size=120)
    data = {"delay": jnp.asarray(delay), "seen": jnp.asarray(seen)}
    problem = Problem(waves, data, [CARRIER])
    base = fitting.fit(problem, problem.null())
    found = scan(problem, base.x, ["carrier"])["carrier"]
    assert found.gain > 0.0
    wider = problem.with_live(["carrier"])
    start = wider.translate(found.x, problem)
    index = wider.layout.indices(["carrier.offset"])
    start[index] = found.parameters
    fitted = fitting.fit(wider, start, ["carrier"])
    assert fitted.x[index] == pytest.approx(offset, abs=0.1)


def test_sizes_are_scanned_whatever_stands_before_them():
    """Places do nothing as long as the size is at its null."""
    size = CARRIER.parameters[0]
    places = tuple(Parameter(name, dist.Normal(0.0, 1.0), is_place=True) for name in ("east", "north"))
    delay = np.random.default_rng(0).uniform(0.0, 0.2, 120)
    seen = np.cos(-2 * np.pi * 31.0 * delay - 1.0)
    data = {"delay": jnp.asarray(delay), "seen": jnp.asarray(seen)}
    gains = []
    for parameters in ((size, *places), (*places, size)):
        problem = Problem(waves, data, [Effect("carrier", CARRIER.rewrites, parameters)])
        base = fitting.fit(problem, problem.null())
        gains.append(scan(problem, base.x, ["carrier"])["carrier"].gain)
    assert gains[1] == pytest.approx(gains[0], rel=1e-6)


def two_sites(delay, seen=None):
    """The same with a level of each path."""
    with numpyro.plate("path", len(delay)):
        phase = numpyro.deterministic("phase", jnp.zeros(len(delay)))
        level = numpyro.deterministic("level", jnp.ones(len(delay)))
        numpyro.sample("seen", dist.Normal(level * jnp.cos(phase - 1.0), 0.1), obs=seen)


def test_effects_that_share_a_run_of_the_model_have_the_gains_that_they_have_alone():
    """Of 7 effects at 2 sites, more than fit in one run; the gains are also those of the rewritten model."""
    size, turn = Parameter("size", dist.Normal(0.0, 0.5)), Parameter("turn", dist.Normal(0.0, 2.0))
    faded = [
        Effect(
            "faded",
            {"level": lambda v, p, c, k=k: v * jnp.exp(p["size"] * jnp.cos(k * c["delay"]))},
            (size,),
            instance=str(k),
        )
        for k in range(4)
    ]
    both = [
        Effect(
            "both",
            {
                "level": lambda v, p, c, k=k: v + p["size"] * c["delay"] ** k,
                "phase": lambda v, p, c, k=k: v + jnp.sin(p["turn"] * (1 + k * c["delay"])),
            },
            (size, turn),
            instance=str(k),
        )
        for k in range(1, 4)
    ]
    rng = np.random.default_rng(2)
    delay = rng.uniform(0.0, 1.0, 40)
    data = {"delay": jnp.asarray(delay), "seen": jnp.asarray(1.3 * np.cos(np.sin(2.0 * delay) - 1.0))}
    problem = Problem(two_sites, data, [*faded, *both])
    x, names = problem.null(), [e.name for e in (*faded, *both)]
    together = scan(problem, x, names, x)
    assert {e.name for e in both} <= set(together)
    before = problem.compiled.by_cluster(x).sum()
    for name, found in together.items():
        assert scan(problem, x, [name], x)[name].gain == pytest.approx(found.gain, rel=1e-12)
        wider = problem.with_live([name])
        moved = wider.translate(found.x, problem)
        moved[wider.layout.of(next(e for e in wider.effects if e.name == name))] = found.parameters
        assert wider.compiled.by_cluster(moved).sum() - before == pytest.approx(found.gain, rel=1e-9)
