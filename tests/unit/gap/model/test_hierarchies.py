"""Levels of groups: which clusters they belong to, and models in which several clusters share them."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.contrib.control_flow import cond, scan

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.diagnose import diagnose
from dtprob.gap.fitting.integrated import based
from dtprob.gap.fitting.soundness import notes
from dtprob.gap.model.decentred import decentred
from dtprob.gap.model.problem import Problem
from dtprob.inference.laplace import Laplace

N_SITE, N_ROW = 20, 300
SPREAD = 2.0


def sensors(x, site, day, y=None, *, n_site=N_SITE):
    """Levels of sites around an unknown mean with an unknown spread, and a slope that all share."""
    mean = numpyro.sample("mean", dist.Normal(0.0, 10.0))
    spread = numpyro.sample("spread", dist.HalfNormal(5.0))
    slope = numpyro.sample("slope", dist.Normal(0.0, 3.0))
    with numpyro.plate("place", n_site):
        level = numpyro.sample("level", dist.Normal(mean, spread))
    expected = numpyro.deterministic("expected", level[site] + slope * x)
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(expected, 0.5), obs=y)


def bend():
    return Effect(
        "bend",
        {"expected": lambda value, p, context: value + p["size"] * (context["x"] ** 2 - 1)},
        (Parameter("size", dist.Normal(0.0, 1.0)),),
        requires=("x",),
    )


def slopes():
    return Effect(
        "slopes",
        {"expected": lambda value, p, context: value + p["sd"] * p["field"][context["site"]] * context["x"]},
        (Parameter("sd", dist.HalfNormal(1.0, validate_args=False)),),
        kind="variance",
        field_shape=lambda *_: (N_SITE,),
        requires=("x", "site"),
    )


@pytest.fixture
def data():
    rng = np.random.default_rng(2)
    site, x = rng.integers(0, N_SITE, N_ROW), rng.normal(size=N_ROW)
    site[:N_SITE] = np.arange(N_SITE)
    level = 3.0 + SPREAD * rng.normal(size=N_SITE)
    y = level[site] + 1.5 * x + 0.5 * rng.normal(size=N_ROW)
    return {"x": x, "site": site, "day": rng.integers(0, 30, N_ROW), "y": y}


def test_levels_belong_to_the_clusters_that_their_column_makes(data):
    problem = Problem(sensors, data, [bend(), slopes()], "site")
    level = problem.layout["level"]
    assert level.local
    assert level.index.shape == (N_SITE, 1)
    assert not problem.layout["mean"].local
    field = problem.with_live(["slopes"]).layout["slopes.field"]
    assert field.local
    x = problem.prior_draws(jax.random.key(1), 1)[0]
    before = problem.compiled.by_cluster(x)
    x[level.index[7]] += 1.0
    changed = problem.compiled.by_cluster(x) != before
    np.testing.assert_array_equal(np.flatnonzero(changed), [7])


@pytest.mark.parametrize("cluster", ["day", None])
def test_levels_that_clusters_share_belong_to_none(data, cluster):
    problem = Problem(sensors, data, [slopes()], cluster)
    assert "level" not in problem.declaration.latent
    assert not problem.layout["level_decentered"].local
    assert not problem.with_live(["slopes"]).layout["slopes.field"].local


def test_a_level_that_acts_in_two_clusters_is_not_one_clusters_own(data):
    def leaking(x, site, day, y=None):
        with numpyro.plate("place", N_SITE):
            level = numpyro.sample("level", dist.Normal(0.0, 3.0))
        next_one = jnp.where(jnp.arange(N_SITE) == 4, jnp.roll(level, 1), 0.0)
        with numpyro.plate("row", len(x)):
            numpyro.sample("y", dist.Normal((level + next_one)[site], 0.5), obs=y)

    assert not Problem(leaking, data, [], "site").layout["level"].local


@pytest.mark.parametrize("cluster", ["site", "day", None])
def test_the_spread_of_levels_is_found(data, cluster):
    """A joint mode of levels and their spread would have a spread of 0, or one that is far too large in units of it."""
    start = based(Problem(sensors, data, [], cluster), jax.random.key(0))
    assert start.fitted.converged
    sites = start.problem.compiled.sites(start.fitted.x)
    assert abs(float(sites["slope"]) - 1.5) < 0.15
    assert SPREAD / 1.5 < float(sites["spread"]) < 1.5 * SPREAD
    assert notes(start.problem, start.fitted) == ()  # the levels tell of their spread
    np.testing.assert_allclose(np.std(sites["level"]), SPREAD, rtol=0.4)


def test_standard_units_leave_the_density_as_it_is(data):
    """Of the level by its spread: log N(a; m, s) + log s = log N((a - m) / s; 0, 1)."""
    drawn = decentred(sensors, data, ["level", "slope"])
    site = numpyro.handlers.trace(numpyro.handlers.seed(drawn, 0)).get_trace(**data)
    assert site["level"]["type"] == "deterministic"
    assert "slope_decentered" not in site
    unit = site["level_decentered"]["value"]
    expected = site["mean"]["value"] + site["spread"]["value"] * unit
    np.testing.assert_allclose(site["level"]["value"], expected, rtol=1e-5)
    assert decentred(sensors, data, ["slope"]) is sensors


@pytest.mark.study
@pytest.mark.parametrize("cluster", ["day", "site"])
def test_a_cause_beside_levels_is_told(data, cluster):
    bent = {**data, "y": data["y"] + 0.4 * (data["x"] ** 2 - 1)}
    for given, verdict in ((data, "NO_GAP"), (bent, "LISTED")):
        found = diagnose(
            sensors, given, (bend(), slopes()), cluster=cluster, engine=Laplace(), key=jax.random.key(0)
        )
        assert found.verdict == verdict
    assert found.causes[0].effects == ("bend",)


ROOM, HOURS = 12, 20


def drifting(load, kind, y=None):
    """A random walk, a Gaussian process and the states of a scan, which all rooms share, each with an unknown spread."""
    scales = {n: numpyro.sample(n, dist.HalfNormal(1.0)) for n in ("step", "size", "jump")}
    noise = numpyro.sample("noise", dist.HalfNormal(2.0))
    gap = jnp.arange(HOURS)[:, None] - jnp.arange(HOURS)
    near = jnp.exp(-0.5 * (gap / 3.0) ** 2) + 1e-4 * jnp.eye(HOURS)
    walk = numpyro.sample("walk", dist.GaussianRandomWalk(scales["step"], num_steps=HOURS))
    curve = numpyro.sample("curve", dist.MultivariateNormal(jnp.ones(HOURS), scales["size"] ** 2 * near))

    def turn(state, _):
        state = numpyro.sample("state", dist.Normal(0.5 * state, scales["jump"]))
        return state, state

    _, states = scan(turn, 0.0, jnp.zeros(HOURS))
    shared = {"walk": walk, "curve": curve, "state": states}[kind]
    with numpyro.plate("room", ROOM, dim=-2), numpyro.plate("hour", HOURS, dim=-1):
        mean = numpyro.deterministic("mean", shared - 2.0 * load)
        numpyro.sample("y", dist.Normal(mean, noise), obs=y)


def heavy():
    rewrite = {"mean": lambda value, p, context: value + p["size"] * context["load"] ** 2}
    return Effect("heavy", rewrite, (Parameter("size", dist.Normal(0.0, 3.0)),), requires=("load",))


def of_rooms(kind, spread=0.7):
    rng = np.random.default_rng(8)
    steps = rng.normal(size=HOURS)
    gap = np.subtract.outer(np.arange(HOURS), np.arange(HOURS))
    root = np.linalg.cholesky(np.exp(-0.5 * (gap / 3.0) ** 2) + 1e-4 * np.eye(HOURS))
    state = np.zeros(HOURS)
    for hour in range(HOURS):
        state[hour] = 0.5 * state[hour - 1] * (hour > 0) + spread * steps[hour]
    shared = {"walk": spread * np.cumsum(steps), "curve": 1 + spread * root @ steps, "state": state}[kind]
    load = rng.uniform(size=(ROOM, HOURS))
    return {"load": load, "kind": kind, "y": shared - 2 * load + rng.normal(size=load.shape)}


def test_what_is_drawn_jointly_is_the_same_in_standard_units():
    """Values from their numbers, and the density less that of the numbers: the logarithm of the map's determinant."""
    data = of_rooms("walk")
    drawn = decentred(drifting, data, ["walk", "curve", "state"])
    site = numpyro.handlers.trace(numpyro.handlers.seed(drawn, 3)).get_trace(**data)
    z = {n: site[f"{n}_decentered"]["value"] for n in ("walk", "curve", "state")}
    step, size, jump = (site[n]["value"] for n in ("step", "size", "jump"))
    np.testing.assert_allclose(site["walk"]["value"], step * np.cumsum(z["walk"]), rtol=1e-4)
    gap = np.subtract.outer(np.arange(HOURS), np.arange(HOURS))
    root = np.linalg.cholesky(size**2 * (np.exp(-0.5 * (gap / 3.0) ** 2) + 1e-4 * np.eye(HOURS)))
    np.testing.assert_allclose(site["curve"]["value"], 1 + root @ z["curve"], rtol=1e-3, atol=1e-3)
    state = 0.0
    for number, found in zip(z["state"], site["state"]["value"], strict=True):
        state = 0.5 * state + jump * number
        np.testing.assert_allclose(found, state, rtol=1e-4, atol=1e-6)


def test_other_control_flow_is_left_as_it_is():
    def told(value, _):
        return numpyro.deterministic("sign", value)

    def branching(load, kind, y=None):
        size = numpyro.sample("size", dist.HalfNormal(1.0))
        with numpyro.plate("place", 5):
            numpyro.sample("level", dist.Normal(0.0, size))
        cond(
            load.sum() > 0,
            lambda _: numpyro.deterministic("sign", 1.0),
            lambda _: numpyro.deterministic("sign", -1.0),
            None,
        )
        with numpyro.plate("room", ROOM, dim=-2), numpyro.plate("hour", HOURS, dim=-1):
            numpyro.sample("y", dist.Normal(0.0 * load, size), obs=y)

    data = of_rooms("walk")
    drawn = decentred(branching, data, ["level"])
    site = numpyro.handlers.trace(numpyro.handlers.seed(drawn, 0)).get_trace(**data)
    assert "level_decentered" in site
    assert site["sign"]["value"] == 1.0


@pytest.mark.study
@pytest.mark.parametrize("kind", ["state", "walk", "curve"])
def test_what_all_clusters_share_of_a_series_is_no_gap(kind):
    """Its joint mode with the spread would be a flat line, and every hour wrong."""
    found = diagnose(
        drifting, of_rooms(kind), [heavy()], cluster="room", engine=Laplace(), key=jax.random.key(0)
    )
    assert found.verdict == "NO_GAP"


def outliers(load, hour, room, y=None):
    """Levels of rooms and of hours, a few far out."""
    rooms = numpyro.sample("rooms", dist.HalfNormal(8.0))
    hours = numpyro.sample("hours", dist.HalfNormal(8.0))
    noise = numpyro.sample("noise", dist.HalfNormal(8.0))
    with numpyro.plate("room", 20):
        own = numpyro.deterministic("own", numpyro.sample("level", dist.StudentT(4.0, 0.0, rooms)))
    with numpyro.plate("hour", 12):
        shared = numpyro.deterministic("shared", numpyro.sample("beat", dist.StudentT(4.0, 0.0, hours)))
    mean = numpyro.deterministic("mean", own[room] + shared[hour])
    with numpyro.plate("row", len(load)):
        numpyro.sample("y", dist.Normal(mean, noise), obs=y)


@pytest.mark.study
@pytest.mark.parametrize("seed", [0, 1])
def test_levels_with_outliers_are_no_gap(seed):
    """Far ones are not at the curvature of their prior: both kinds rang alarms of p 1e-8 and less."""
    rng = np.random.default_rng(seed)
    room, hour = rng.integers(0, 20, 400), rng.integers(0, 12, 400)
    levels = 5 * rng.standard_t(4, 20), 2 * rng.standard_t(4, 12)
    load = rng.uniform(size=400)
    y = levels[0][room] + levels[1][hour] + 3 * rng.standard_normal(400)
    data = {"load": load, "hour": hour, "room": room, "y": y}
    found = diagnose(outliers, data, [heavy()], cluster="room", engine=Laplace(), key=jax.random.key(0))
    assert found.verdict == "NO_GAP"
    problem = Problem(outliers, data, [heavy()], cluster="room")
    assert set(problem.own) == {"level_decentered"}
    assert problem.decentred == {"beat_decentered"}
