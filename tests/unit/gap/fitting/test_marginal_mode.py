"""Refits beside what is integrated out: the mode of the marginal density, not where noise vanishes or spreads are off."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.contrib.control_flow import scan
from scipy import optimize

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting import marginal_mode
from dtprob.gap.fitting.integrated import based
from dtprob.gap.fitting.marginal_mode import about_the_mode, around, height_at, steps
from dtprob.gap.fitting.refit import polished, refit, starting_points
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.models.declaration import model


def levels(device, error, y=None):
    """Readings of devices, each at a level of its own, with errors of known size."""
    middle, spread = (
        numpyro.sample("middle", dist.Normal(10.0, 5.0)),
        numpyro.sample("spread", dist.HalfNormal(3.0)),
    )
    with numpyro.plate("device", DEVICES):
        level = numpyro.sample("level", dist.Normal(middle, spread))
    with numpyro.plate("row", len(device)):
        size = numpyro.deterministic("size", error)
        numpyro.sample("y", dist.Normal(level[device], size), obs=y)


DEVICES = 60
LOUDER = Effect(
    "louder",
    {"size": lambda value, p, _: value * jnp.exp(p["log_factor"])},
    (Parameter("log_factor", dist.Normal(0.0, 0.5)),),
)


def readings(seed, factor):
    rng = np.random.default_rng(seed)
    device = np.repeat(np.arange(DEVICES), rng.integers(2, 6, DEVICES))
    error = rng.uniform(0.8, 1.6, len(device))
    level = rng.normal(11.0, 1.5, DEVICES)
    y = level[device] + factor * error * rng.normal(size=len(device))
    return {"device": jnp.asarray(device), "error": jnp.asarray(error), "y": jnp.asarray(y)}


def exact(data):
    """Log of the factor, and its standard deviation, where levels are integrated out in closed form."""
    device, error, y = (data[name] for name in ("device", "error", "y"))

    def loss(at):
        variance, between = error**2 * jnp.exp(2 * at[2]), jnp.exp(2 * at[1])
        precision, pull = (
            jnp.bincount(device, weight, length=DEVICES) for weight in (1 / variance, (y - at[0]) / variance)
        )
        square = jnp.sum((y - at[0]) ** 2 / variance) - jnp.sum(pull**2 * between / (1 + between * precision))
        prior = (at[0] - 10) ** 2 / 25 + between / 9 - 2 * at[1] + at[2] ** 2 / 0.25
        return 0.5 * (jnp.log(variance).sum() + jnp.log1p(between * precision).sum() + square + prior)

    found = optimize.minimize(loss, [10.0, 0.3, 0.2], jac=jax.grad(loss))
    return found.x[2], np.sqrt(np.linalg.inv(jax.hessian(loss)(jnp.asarray(found.x)))[2, 2])


def refitted(problem, effect):
    """The base fit, and the one with the effect, freed from local optima as a search does it."""
    start = based(problem, jax.random.key(0))
    live = start.problem.with_live([effect.name])
    x = live.translate(start.fitted.x, start.problem)
    starts = starting_points(live, x, effect, None, Settings())
    found = refit(live, start.fitted, effect, starts)
    return live, start.fitted, polished(live, start.fitted, {effect.name: found}, 3)[effect.name]


@pytest.mark.study
@pytest.mark.parametrize("factor", [1.0, 1.3])
def test_the_size_of_noise_beside_levels_of_many_devices(factor):
    """The joint expansion without the effect's own volume stopped .12 short of it."""
    data = readings(3, factor)
    problem = Problem(levels, data, [LOUDER], "device")
    live, _, found = refitted(problem, LOUDER)
    there, deviation = exact(data)
    (index,) = live.layout.indices(["louder.log_factor"])
    assert found.x[index] == pytest.approx(there, abs=0.25 * deviation)
    assert found.volume is not None
    assert index in found.volume.index


@pytest.mark.study
def test_differences_are_taken_within_what_the_data_leave_open():
    """Sixty levels tell their middle to .2: a tenth of its prior, .5, would leave where the expansion holds."""
    start = based(Problem(levels, readings(3, 1.0), [], "device"), jax.random.key(0))
    free = around(start.problem)
    joint = start.fitted
    step = steps(free, joint)
    posterior = np.sqrt(np.diag(joint.covariance))[np.searchsorted(joint.global_index, free.index)]
    tight = 0.5 * posterior < 0.1 * free.scale
    assert tight.any()
    np.testing.assert_allclose(step[tight], 0.5 * posterior[tight])
    np.testing.assert_allclose(step[~tight], 0.1 * free.scale[~tight])


def test_the_mode_is_found_from_far_with_the_volume_expanded_whole_at_both_ends_only(monkeypatch):
    problem = Problem(levels, readings(3, 1.3), [LOUDER], "device").with_live(["louder"])
    free = around(problem, ["louder"])
    far = problem.null()
    far[free.index] += [2.0, 1.0, -0.5]
    far, height = height_at(problem, far, free)
    whole = []
    expanded = marginal_mode._expanded
    monkeypatch.setattr(marginal_mode, "_expanded", lambda *given: whole.append(given[1]) or expanded(*given))
    mode = about_the_mode(problem, far, height, free)
    assert mode.arrived
    assert mode.height > height + 400.0
    (index,) = problem.layout.indices(["louder.log_factor"])
    there, deviation = exact(readings(3, 1.3))
    assert mode.x[index] == pytest.approx(there, abs=0.05 * deviation)
    assert len(whole) == 3  # five rounds
    np.testing.assert_array_equal(whole[-1], mode.x)


def test_slopes_by_steps_to_one_side_are_those_of_the_whole_expansion():
    problem = Problem(levels, readings(3, 1.3), [LOUDER], "device").with_live(["louder"])
    free = around(problem, ["louder"])
    x, _ = height_at(problem, problem.null(), free)
    whole = marginal_mode._expanded(problem, x, free)
    slope = marginal_mode._sloped(problem, x, free, whole).slope
    assert np.abs(whole.slope).max() > 0.5
    np.testing.assert_allclose(slope, whole.slope, atol=1e-4)


@model(axes={"offset": ("week", "cell"), "y": ("week", "cell")})
def trends(busy, y=None):
    """Levels and slopes of cells that wander, all three spreads unknown."""
    bend = numpyro.sample("bend", dist.HalfNormal(0.3))
    wander = numpyro.sample("wander", dist.HalfNormal(0.6))
    noise = numpyro.sample("noise", dist.HalfNormal(2.0))
    cells = busy.shape[1]
    with numpyro.plate("cell", cells):
        level, slope = (
            numpyro.sample("level", dist.Normal(-80.0, 5.0)),
            numpyro.sample("slope", dist.Normal(0.0, 0.5)),
        )

    def week(carry, _):
        level, slope = carry
        with numpyro.plate("cell", cells):
            slope = slope + bend * numpyro.sample("turn", dist.Normal(0.0, 1.0))
            level = level + slope + wander * numpyro.sample("step", dist.Normal(0.0, 1.0))
            offset = numpyro.deterministic("offset", jnp.zeros(cells))
            numpyro.sample("y", dist.Normal(level + offset, noise))
        return (level, slope), None

    with numpyro.handlers.condition(data={} if y is None else {"y": y}):
        scan(week, (level, slope), busy)


BUSY = Effect(
    "busy",
    {"offset": lambda value, p, context: value + p["db"] * context["busy"]},
    (Parameter("db", dist.Normal(0.0, 2.0), unit="dB"),),
)


def weeks(seed, db):
    rng = np.random.default_rng(seed)
    level, slope, y = rng.normal(-80, 3, 25), rng.normal(0, 0.2, 25), np.zeros((24, 25))
    busy = 1.0 * (rng.uniform(size=y.shape) < 0.25)
    for t in range(24):
        slope = slope + rng.normal(0, 0.1, 25)
        level = level + slope + rng.normal(0, 0.3, 25)
        y[t] = level + rng.normal(0, 1, 25)
    return {"busy": jnp.asarray(busy), "y": jnp.asarray(y + db * busy)}


@pytest.mark.study
def test_noise_does_not_vanish_beside_states():
    problem = Problem(trends, weeks(10, -1.1), [BUSY], "cell")
    live, before, found = refitted(problem, BUSY)
    assert found.log_evidence - before.log_evidence > 35.0  # first-order scores promise 44
    size, noise = (found.x[live.layout.indices([name])[0]] for name in ("busy.db", "noise"))
    assert size == pytest.approx(-1.15, abs=0.2)
    assert np.exp(noise) == pytest.approx(1.0, abs=0.15)
