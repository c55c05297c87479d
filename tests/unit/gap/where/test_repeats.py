"""Readings that are exactly alike: told where a receiver ends or a sensor is stuck, silent where data are only rounded."""

from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

import dtprob
from dtprob.gap.observation.whiten import observation
from dtprob.gap.where.repeats import repeats
from dtprob.gap.where.site_finding import SURE

N = 400


def found(law, values, counted=True):
    """What is said of one observation."""
    values = jnp.asarray(values)
    counted = np.broadcast_to(counted, values.shape)
    seen = {"level": observation(law, values, "level")}
    problem = SimpleNamespace(
        observed=SimpleNamespace(values={"level": values}, counted={"level": counted}),
        compiled=SimpleNamespace(observations=lambda _x: seen),
    )
    return list(repeats(cast("Any", problem), np.zeros(0)))


def levels(seed, n=N):
    rng = np.random.default_rng(seed)
    mean = rng.uniform(-110.0, -70.0, n)
    return mean, mean + 4.0 * rng.normal(size=n)


@pytest.mark.parametrize(
    ("cut", "value"),
    [
        (lambda y: np.minimum(y, np.sort(y)[-12]), None),
        (lambda y: np.maximum(y, np.sort(y)[11]), None),
        (lambda y: np.where(np.arange(N) % 40 == 3, -85.0, y), -85.0),  # a default
        (lambda y: np.where((np.arange(N) > 100) & (np.arange(N) < 111), y[100], y), None),  # stuck
    ],
    ids=["ceiling", "floor", "default", "stuck"],
)
@pytest.mark.parametrize("step", [0.0, 0.01])
def test_what_is_read_too_often_is_told(cut, value, step):
    mean, level = levels(1)
    level = cut(level)
    level = np.round(level / step) * step if step else level
    (one,) = found(dist.Normal(mean, 4.0), level)
    assert one.p_value < 1e-3
    assert one.moment == "repeats"
    said = float(one.place.split()[2].rstrip(","))
    often, count = stats.mode(level)
    assert said == pytest.approx(often if value is None else value, abs=1e-3)
    assert one.place.endswith(f"read {count} times")


@pytest.mark.parametrize("step", [0.0, 0.01, 0.1, 0.5, 1.0, 3.0, 10.0])
def test_rounded_readings_of_a_right_twin_are_silent(step):
    """Of 100 data sets at each step as many may be told as the level allows; that more are has a chance of .0001."""
    told = 0
    for seed in range(100):
        mean, level = levels(seed)
        level = np.round(level / step) * step if step else level
        told += bool(found(dist.Normal(mean, 4.0), level))
    assert told <= stats.binom.isf(1e-4 / 7, 100, SURE)


def test_a_sensor_that_is_stuck_for_a_while_is_told_however_coarse_its_readings():
    mean, level = levels(6)
    level = np.round(level)
    common = np.round(np.median(level))
    stuck = np.where((np.arange(N) >= 200) & (np.arange(N) < 212), common, level)
    (one,) = found(dist.Normal(mean, 4.0), stuck)
    assert one.place == f"the value {common:g}, read 12 times in a row"
    several = np.stack([level, stuck, level[::-1]], axis=1)
    (again,) = found(dist.Normal(jnp.stack([mean, mean, mean[::-1]], axis=1), 4.0), several)
    assert again.place == one.place


@pytest.mark.parametrize("step", [0.1, 1.0, 3.0, 5.0, 8.0])
def test_neighbours_that_are_often_alike_are_not_stuck(step):
    """Shadowing that changes slowly, of which the twin does not know: neighbours are alike everywhere."""
    told = 0
    for seed in range(100):
        rng = np.random.default_rng(1000 + seed)
        slow = np.zeros(N)
        for i in range(1, N):
            slow[i] = 0.97 * slow[i - 1] + 4.0 * np.sqrt(1 - 0.97**2) * rng.normal()
        told += bool(found(dist.Normal(np.full(N, -90.0), 4.0), np.round((-90.0 + slow) / step) * step))
    assert told <= stats.binom.isf(1e-4 / 4, 100, SURE)


@pytest.mark.parametrize(
    ("law", "draw"),
    [
        (lambda: dist.StudentT(3.0, 0.0, 2.0), lambda rng: 2.0 * rng.standard_t(3, N)),
        (lambda: dist.Exponential(1.0), lambda rng: rng.exponential(size=N)),
        (lambda: dist.LogNormal(0.0, 1.0), lambda rng: np.exp(rng.normal(size=N))),
        (lambda: dist.Gamma(2.0, 1.0), lambda rng: rng.gamma(2.0, size=N)),
    ],
    ids=["StudentT", "Exponential", "LogNormal", "Gamma"],
)
@pytest.mark.parametrize("step", [0.01, 0.2, 0.5])
def test_the_twins_density_tells_how_often_a_value_is_read(law, draw, step):
    for seed in range(20):
        values = (np.floor(draw(np.random.default_rng(seed)) / step) + 0.5) * step
        assert not found(law().expand([N]), values)


def test_a_value_that_the_twin_expects_is_no_surprise():
    """Ten transmitters, each read forty times with an error below the resolution: all their readings are alike."""
    rng = np.random.default_rng(0)
    mean = rng.permutation(np.repeat(np.linspace(-100.0, -80.3, 10), 40))
    level = np.round(mean + 0.01 * rng.normal(size=N), 1)
    assert not found(dist.Normal(mean, 0.01), level)
    level[:30] = level[-1]
    assert found(dist.Normal(mean, 0.01), level)


def test_vectors_are_looked_at_entry_by_entry():
    mean, level = levels(2)
    covariance = 16.0 * (0.5 * np.eye(8) + 0.5)
    law = dist.MultivariateNormal(jnp.asarray(mean.reshape(50, 8)), covariance)
    assert not found(law, level.reshape(50, 8))
    assert found(law, np.minimum(level, np.sort(level)[-15]).reshape(50, 8))
    rng = np.random.default_rng(8)
    near = 4.0 * rng.normal(size=(50, 1)) + 0.04 * rng.normal(
        size=(50, 8)
    )  # each tells the next, but not its value
    law = dist.MultivariateNormal(jnp.zeros((50, 8)), 16.0 * (0.9999 + 0.0001 * np.eye(8)))
    assert not found(law, near)
    assert found(law, np.minimum(near, np.sort(near.ravel())[-32]))


def test_one_reading_that_is_filed_for_every_antenna_is_no_sensor_that_is_stuck():
    mean, level = levels(7)
    law = dist.Normal(jnp.asarray(mean)[:, None], 4.0).expand([N, 6])
    assert not found(law, np.repeat(level[:, None], 6, axis=1))


def test_what_does_not_count_is_not_counted():
    mean, level = levels(3)
    seen = np.arange(N) > 30
    level[~seen] = 0.0
    assert not found(dist.Normal(mean, 4.0).mask(seen), level, seen)
    assert found(dist.Normal(mean, 4.0), level)


@pytest.mark.parametrize(
    "law",
    [
        lambda y: dist.LeftCensoredDistribution(dist.Normal(-90.0, 12.0).expand([N]), y <= y.min()),
        lambda y: dist.Categorical(logits=jnp.zeros((N, 5))),
    ],
    ids=["floor", "outcomes"],
)
def test_where_values_may_be_alike_nothing_is_looked_at(law):
    _, level = levels(4)
    level = np.maximum(level, np.sort(level)[60])
    law = law(level)
    values = np.full(N, 4) if isinstance(law, dist.CategoricalLogits) else level
    assert not found(law, values)


def path_loss(distance, level=None):
    """A twin that knows of no floor and no default."""
    exponent = numpyro.sample("exponent", dist.Normal(3.0, 1.0))
    at_one_metre = numpyro.sample("at_one_metre", dist.Normal(-40.0, 10.0))
    noise = numpyro.sample("noise", dist.LogNormal(1.0, 1.0))
    mean = numpyro.deterministic("mean", at_one_metre - 10 * exponent * jnp.log10(distance))
    with numpyro.plate("position", distance.shape[0]):
        numpyro.sample("level", dist.Normal(mean, noise), obs=level)


@pytest.mark.parametrize(
    ("cut", "value"),
    [(lambda y: np.maximum(y, -111.0), -111), (lambda y: np.where(np.arange(300) % 30 == 3, 0.0, y), 0)],
    ids=["floor", "default"],
)
def test_a_diagnosis_says_it_first(cut, value):
    """A default far off spreads the readings far more surely than it is counted."""
    rng = np.random.default_rng(5)
    distance = rng.uniform(5, 200, 300)
    level = cut(np.round(-40 - 30 * np.log10(distance) + 4 * rng.normal(size=300), 1))
    data = {"distance": jnp.asarray(distance), "level": jnp.asarray(level)}
    seen = dtprob.diagnose(path_loss, data, key=jax.random.key(0))
    assert seen.verdict == "UNLISTED"
    assert f"the value {value}, read {(level == value).sum()} times" in seen.summary
    assert seen.sections["where"]["sites"][0]["family"] == "repeats, each"
