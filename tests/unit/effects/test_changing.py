"""Effects on sites inside NumPyro's `scan`."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro import handlers
from numpyro.contrib.control_flow import scan

from dtprob.effects import Effect, Parameter, Rewriting, with_effects
from dtprob.errors import InputError
from dtprob.models.declaration import declare

USERS, SLOTS = 3, 5
LOAD = jnp.asarray(np.random.default_rng(0).uniform(size=(SLOTS, USERS)))
SEEN = jnp.asarray(np.random.default_rng(1).normal(size=(SLOTS, USERS)))
DATA = {"load": LOAD, "y": SEEN}
STATE = jnp.asarray(np.random.default_rng(2).normal(size=(SLOTS, USERS)))


def scanned(load, y=None):
    """States of users in a scan over slots, and what is expected of each."""

    def step(state, now):
        own, seen = now
        with numpyro.plate("user", load.shape[1]):
            state = numpyro.sample("state", dist.Normal(0.8 * state, 0.5))
            level = numpyro.deterministic("level", 2.0 + state)
            mean = numpyro.deterministic("mean", level * (1 + own))
            numpyro.sample("y", dist.Normal(mean, 0.3), obs=seen)
        return state, None

    scan(step, jnp.zeros(load.shape[1]), (load, y), length=len(load))


def whole(load, y=None):
    """The same without a scan, the states given."""
    level = numpyro.deterministic("level", 2.0 + STATE)
    mean = numpyro.deterministic("mean", level * (1 + load))
    numpyro.sample("y", dist.Normal(mean, 0.3), obs=y)


def smooth(value, p, context):
    """Of the whole series at once: a step looks at its neighbours."""
    return value + p["size"] * (jnp.roll(value, 1, axis=0) + context["load"])


RAISED = Effect("raised", {"level": smooth}, (Parameter("size", dist.Normal(0.0, 1.0)),), requires=("load",))
SCALED = Effect(
    "scaled",
    {"mean": lambda value, p, context: value * (1 + p["size"] * context["level"])},
    (Parameter("size", dist.Normal(0.0, 1.0)),),
    requires=("level",),
)
TAILS = Effect(
    "tails",
    {},
    (Parameter("excess", dist.HalfNormal(1.0)),),
    distributions={"y": lambda fn, p, _: dist.Normal(fn.loc, fn.scale * (1 + p["excess"]))},
)
GIVEN = {"raised": {"size": 0.3}, "scaled": {"size": -0.2}, "tails": {"excess": 0.5}}


def trace(model, effects):
    with (
        handlers.trace() as found,
        Rewriting(None, effects, GIVEN, DATA),
        handlers.substitute(data={"state": STATE}),
        handlers.seed(rng_seed=0),
    ):
        model(**DATA)
    return found


@pytest.mark.parametrize("effects", [[RAISED], [SCALED], [RAISED, SCALED, TAILS]])
def test_effects_see_and_change_whole_series(effects):
    inside, outside = trace(scanned, effects), trace(whole, effects)
    for name in ("level", "mean"):
        np.testing.assert_allclose(inside[name]["value"], outside[name]["value"], rtol=1e-6)
    density = [t["y"]["fn"].log_prob(t["y"]["value"]) for t in (inside, outside)]
    np.testing.assert_allclose(*density, rtol=1e-5)


def test_extended_models_nest_in_a_scan():
    inner = with_effects(scanned, [RAISED])
    assert {"raised.size", "level"} <= set(declare(inner, DATA).sites)
    both, once = with_effects(inner, [SCALED]), with_effects(scanned, [RAISED, SCALED])
    fixed = {"state": STATE, "raised.size": 0.3, "scaled.size": -0.2}
    means = [
        handlers.trace(handlers.seed(handlers.substitute(m, fixed), 0)).get_trace(**DATA)["mean"]["value"]
        for m in (both, once)
    ]
    np.testing.assert_allclose(*means, rtol=1e-6)
    np.testing.assert_allclose(means[0], trace(whole, [RAISED, SCALED])["mean"]["value"], rtol=1e-6)


def carried(load, y=None):
    """What an effect changes acts on later slots."""

    def step(queue, now):
        served = numpyro.deterministic("served", 0.4 * queue)
        queue = queue - served + now
        return queue, None

    last, _ = scan(step, jnp.ones(load.shape[1]), load)
    numpyro.sample("y", dist.Normal(last, 1.0), obs=None if y is None else y[-1])


SLOWER = Effect(
    "slower",
    {"served": lambda value, p, context: value * (1 - p["share"] * context["load"])},
    (Parameter("share", dist.Normal(0.0, 0.3)),),
    requires=("load",),
)


@pytest.mark.parametrize("share", [1e-3, 1e-2, 1e-1])
def test_changes_that_are_carried_on(share):
    with handlers.trace() as found, Rewriting(None, [SLOWER], {"slower": {"share": share}}, DATA):
        carried(**DATA)
    queue = jnp.ones(USERS)
    for load in LOAD:
        queue = queue - 0.4 * queue * (1 - share * load) + load
    np.testing.assert_allclose(found["y"]["fn"].loc, queue, rtol=max(share**3, 1e-6))


def test_slopes_along_an_effect_in_a_scan():
    def loss(size):
        with (
            handlers.trace() as found,
            Rewriting(None, [RAISED], {"raised": {"size": size}}, DATA),
            handlers.substitute(data={"state": STATE}),
            handlers.seed(rng_seed=0),
        ):
            scanned(**DATA)
        return jnp.sum(found["y"]["fn"].log_prob(SEEN))

    with jax.enable_x64(True):
        step = 1e-5
        slope = (loss(0.1 + step) - loss(0.1 - step)) / (2 * step)
        np.testing.assert_allclose(jax.grad(loss)(0.1), slope, rtol=1e-4)


def test_what_is_drawn_in_a_scan_keeps_its_distribution():
    with pytest.raises(InputError, match="distribution of site 'y' in a scan"):
        handlers.trace(handlers.seed(with_effects(scanned, [TAILS]), 0)).get_trace(load=LOAD)


def test_a_scan_within_a_plate_is_refused():
    def wrong(load, y=None):
        with numpyro.plate("user", load.shape[1]):
            scanned(load, y)

    with pytest.raises(InputError, match="scan within a plate"):
        declare(wrong, DATA)
