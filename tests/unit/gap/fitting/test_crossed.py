"""Levels of clusters beside levels that clusters share: their spreads are those of the exact marginal mode."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import optimize, stats

from dtprob.gap.fitting.fit import fit
from dtprob.gap.fitting.integrated import based
from dtprob.gap.fitting.marginal import marginal
from dtprob.gap.fitting.states import held, states
from dtprob.gap.model.problem import Problem
from dtprob.models.declaration import model

DEVICES, DAYS = 24, 30
AXES = {"mean": ("row",)}


def unknown():
    """The centre of all levels, the spread between devices, the spread between days."""
    return (
        numpyro.sample("centre", dist.Normal(0.0, 3.0)),
        numpyro.sample("between_devices", dist.HalfNormal(1.0)),
        numpyro.sample("between_days", dist.HalfNormal(1.0)),
    )


def read(mean, y):
    noise = numpyro.sample("noise", dist.LogNormal(-1.0, 1.0))
    with numpyro.plate("row", len(mean)):
        numpyro.sample("y", dist.Normal(numpyro.deterministic("mean", mean), noise), obs=y)


@model(axes=AXES, cluster="device")
def in_units(device, day, y=None):
    """Levels as they are mostly written: standard normal numbers times a spread."""
    centre, between_devices, between_days = unknown()
    with numpyro.plate("devices", DEVICES):
        u = numpyro.sample("u", dist.Normal(0.0, 1.0))
    with numpyro.plate("days", DAYS):
        w = numpyro.sample("w", dist.Normal(0.0, 1.0))
    read(centre + between_devices * u[device] + between_days * w[day], y)


@model(axes=AXES, cluster="device")
def centred(device, day, y=None):
    """The same model, its levels drawn with the spread."""
    centre, between_devices, between_days = unknown()
    with numpyro.plate("devices", DEVICES):
        u = numpyro.sample("u", dist.Normal(0.0, between_devices))
    with numpyro.plate("days", DAYS):
        w = numpyro.sample("w", dist.Normal(0.0, between_days))
    read(centre + u[device] + w[day], y)


@model(axes=AXES, cluster="device")
def of_days_alone(device, day, y=None):
    centre = numpyro.sample("centre", dist.Normal(0.0, 3.0))
    between_days = numpyro.sample("between_days", dist.HalfNormal(1.0))
    with numpyro.plate("days", DAYS):
        w = numpyro.sample("w", dist.Normal(0.0, 1.0))
    read(centre + between_days * w[day] + 0.0 * device, y)


@model(axes=AXES, cluster="device")
def regression(device, day, y=None):
    """Several coefficients, none of them in units of another unknown."""
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0).expand([3]).to_event(1))
    read(slope[0] + slope[1] * day / DAYS + slope[2] * device / DEVICES, y)


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(0)
    device, day = (index.ravel() for index in np.indices((DEVICES, DAYS)))
    kept = rng.random(len(device)) < 0.4
    device, day = device[kept], day[kept]
    y = 1.0 + 0.3 * rng.normal(size=DEVICES)[device] + 0.1 * rng.normal(size=DAYS)[day]
    return {"device": device, "day": day, "y": y + 0.4 * rng.normal(size=len(y))}


def exact(data, *, devices):
    """Mode of the marginal density of logarithms of spreads and the centre."""
    groups = [(data["day"][:, None] == data["day"]), (data["device"][:, None] == data["device"])]

    def loss(x):
        noise, *spreads = np.exp(x[1:])
        parts = sum(s**2 * group for s, group in zip(spreads, groups, strict=False))
        covariance = noise**2 * np.eye(len(data["y"])) + parts
        value = stats.multivariate_normal(np.full(len(data["y"]), x[0]), covariance).logpdf(data["y"])
        value += stats.norm(0, 3).logpdf(x[0]) + stats.norm(-1, 1).logpdf(x[1])
        return -(value + sum(stats.halfnorm(0, 1).logpdf(s) + np.log(s) for s in spreads))

    start = np.array([1.0, -1.0, -2.0, *([-1.0] if devices else [])])
    return np.exp(optimize.minimize(loss, start, method="BFGS").x[1:])


@pytest.mark.study
@pytest.mark.parametrize("twin", [in_units, of_days_alone, centred])
def test_spreads_are_those_of_the_marginal_mode(twin, data):
    """At the joint mode the spread of days was five times too large, and hid what changed from day to day."""
    found = based(
        Problem(twin, {n: jnp.asarray(v) for n, v in data.items()}, [], "device"), jax.random.key(0)
    )
    names = ["noise", "between_days", *(["between_devices"] if twin is not of_days_alone else [])]
    values = found.problem.compiled.sites(found.fitted.x)
    told = [float(values[name]) for name in names]
    assert found.fitted.converged
    np.testing.assert_allclose(told, exact(data, devices=len(names) == 3), rtol=0.05)


@pytest.mark.study
@pytest.mark.parametrize(
    ("twin", "expected"),
    [(in_units, {"w"}), (of_days_alone, {"w"}), (centred, {"w_decentered"}), (regression, set())],
)
def test_what_is_drawn_in_units_of_another(twin, expected, data):
    problem = Problem(twin, {n: jnp.asarray(v) for n, v in data.items()}, [], "device")
    assert problem.in_units == expected
    assert len(states(problem).global_index) == (DAYS if expected else 0)
    shared = {
        "centre",
        "noise",
        "between_days",
        "between_devices",
        "slope",
    } & problem.declaration.latent.keys()
    size = {"slope": 3}
    assert len(held(problem)) == sum(size.get(name, 1) for name in shared)


@pytest.mark.study
def test_readings_that_are_left_out_are_judged_by_all_that_is_not_known_of_states():
    """A walk of 120 steps, of which every third reading is left out: its density is that of Kriging."""
    rng = np.random.default_rng(2)
    count = 120
    y = np.cumsum(2.0 * rng.normal(size=count)) + rng.normal(size=count)
    kept = (np.arange(count) % 3 > 0).astype(float)

    def walk(y=None):
        step = numpyro.sample("step", dist.LogNormal(jnp.log(2.0), 0.01))
        shadowing = numpyro.sample("shadowing", dist.GaussianRandomWalk(step, num_steps=count))
        with numpyro.plate("time", count):
            numpyro.sample("y", dist.Normal(numpyro.deterministic("level", shadowing), 1.0), obs=y)

    problem = Problem(walk, {"y": jnp.asarray(y)}, [])
    found = fit(problem, problem.null(), weights=kept)
    step = float(problem.compiled.sites(found.x)["step"])
    at = np.arange(1, count + 1)
    covariance = step**2 * np.minimum.outer(at, at)
    seen, left = np.flatnonzero(kept), np.flatnonzero(kept == 0)
    weights = np.linalg.solve(
        covariance[np.ix_(seen, seen)] + np.eye(len(seen)), covariance[np.ix_(seen, left)]
    )
    spread = covariance[left, left] - (covariance[np.ix_(left, seen)] * weights.T).sum(1) + 1.0
    expected = stats.norm(weights.T @ y[seen], np.sqrt(spread)).logpdf(y[left])
    np.testing.assert_allclose(marginal(problem, found)[left], expected, rtol=1e-3, atol=1e-2)


def test_devices_that_are_left_out_are_judged_by_what_is_not_known_of_days():
    """Every third device is left out: the density of its readings given all others is that of a normal vector."""
    rng = np.random.default_rng(4)
    devices, days = 12, 16
    device, day = (
        index.reshape(-1) for index in np.meshgrid(np.arange(devices), np.arange(days), indexing="ij")
    )
    seldom = rng.random(len(device)) < 0.4
    device, day = device[seldom], day[seldom]
    y = 1.5 * rng.normal(size=devices)[device] + 2.0 * rng.normal(size=days)[day] + rng.normal(size=len(day))

    def crossed(device, day, y=None):
        step = numpyro.sample("step", dist.LogNormal(jnp.log(2.0), 0.01))
        with numpyro.plate("devices", devices):
            own = numpyro.sample("own", dist.Normal(0.0, 1.5))
        with numpyro.plate("days", days):
            level = numpyro.sample("level", dist.Normal(0.0, step))
        read_exactly(own[device] + level[day], y)

    def read_exactly(mean, y):
        with numpyro.plate("row", len(mean)):
            numpyro.sample("y", dist.Normal(numpyro.deterministic("mean", mean), 1.0), obs=y)

    data = {"device": jnp.asarray(device), "day": jnp.asarray(day), "y": jnp.asarray(y)}
    problem = Problem(model(axes=AXES, cluster="device")(crossed), data, [], "device")
    kept = (np.arange(devices) % 3 > 0).astype(float)
    found = fit(problem, problem.null(), weights=kept)
    step = float(problem.compiled.sites(found.x)["step"])
    same = (np.equal.outer(device, device), np.equal.outer(day, day))
    covariance = 1.5**2 * same[0] + step**2 * same[1] + np.eye(len(y))
    seen = kept[device] > 0
    for left in np.flatnonzero(kept == 0):
        own = device == left
        gain = np.linalg.solve(covariance[np.ix_(seen, seen)], covariance[np.ix_(seen, own)]).T
        spread = covariance[np.ix_(own, own)] - gain @ covariance[np.ix_(seen, own)]
        expected = stats.multivariate_normal(gain @ y[seen], spread).logpdf(y[own])
        assert abs(marginal(problem, found)[left] - expected) < 0.02, left


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_what_moves_all_readings_of_a_cluster_is_no_doubt_of_levels(shift):
    """Sites' levels and their centre are each known poorly, their sums well; those excused most of a slot's shift."""
    rng = np.random.default_rng(6)
    slots, sites = 40, 12
    y = 1.0 + 0.5 * rng.normal(size=sites) + 0.3 * rng.normal(size=(slots, sites))
    kept = (np.arange(slots) % 4 > 0).astype(float)
    y[kept == 0] += shift

    def levels(y=None):
        centre = numpyro.sample("centre", dist.Normal(0.0, 3.0))
        spread = numpyro.sample("spread", dist.LogNormal(jnp.log(0.5), 0.01))
        with numpyro.plate("site", sites, dim=-1):
            own = numpyro.sample("own", dist.Normal(0.0, 1.0))
            with numpyro.plate("slot", slots, dim=-2):
                mean = numpyro.deterministic("mean", jnp.broadcast_to(centre + spread * own, (slots, sites)))
                numpyro.sample("y", dist.Normal(mean, 0.3), obs=y)

    problem = Problem(levels, {"y": jnp.asarray(y)}, [], "slot")
    found = fit(problem, problem.null(), weights=kept)
    values = {name: float(problem.compiled.sites(found.x)[name]) for name in ("centre", "spread")}
    seen = y[kept > 0] - values["centre"]
    variance = 1 / (1 / values["spread"] ** 2 + len(seen) / 0.3**2)
    level = values["centre"] + variance * seen.sum(axis=0) / 0.3**2
    expected = stats.norm(level, np.sqrt(0.3**2 + variance)).logpdf(y[kept == 0]).sum(axis=1)
    np.testing.assert_allclose(marginal(problem, found)[kept == 0], expected, rtol=1e-3, atol=1e-2)
