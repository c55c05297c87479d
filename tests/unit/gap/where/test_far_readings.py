"""A few readings that lie far out are told as such wherever they are; many at one place are told by the place."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.bootstrap import replicate
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.where.bounded import few
from dtprob.gap.where.families import Family, Pattern
from dtprob.gap.where.family_test import family_test
from dtprob.gap.where.locate import locate
from dtprob.gap.where.moments import _but_farthest
from dtprob.gap.where.site_finding import SURE, SiteFinding, rank, shadows_last
from dtprob.models.declaration import model

DAYS, EACH, NODES = 60, 9, 12
COUNT = DAYS * EACH


@model(axes={"mean": ("row",), "deviation": ("row",)}, cluster="day")
def nodes_heard(day, node, hour, distance, rssi=None):
    """Levels of twelve nodes over sixty days, falling with distance."""
    del hour
    level = numpyro.sample("level", dist.Normal(-60.0, 15.0))
    exponent = numpyro.sample("exponent", dist.Normal(2.5, 0.7))
    noise = numpyro.sample("noise", dist.LogNormal(0.4, 0.7))
    with numpyro.plate("node", NODES):
        offset = numpyro.sample("offset", dist.Normal(0.0, 3.0))
    loss = 10 * exponent * jnp.log10(distance / 10)
    mean = numpyro.deterministic("mean", level + offset[node] - loss)
    deviation = numpyro.deterministic("deviation", noise * jnp.ones_like(distance))
    with numpyro.plate("row", len(day)):
        numpyro.sample("rssi", dist.Normal(mean, deviation), obs=rssi)


def found_where(change, seed=5):
    """What is found where errors (row,) of unit variance are changed, given the data's columns and a generator."""
    rng = np.random.default_rng(seed)
    day = np.repeat(np.arange(DAYS), EACH)
    columns = {
        "day": day,
        "node": rng.integers(0, NODES, COUNT),
        "hour": np.sort(rng.uniform(0, 24, (DAYS, EACH)), axis=1).reshape(-1),
        "distance": rng.uniform(20.0, 300.0, COUNT),
    }
    error = change(rng.normal(size=COUNT), columns, rng)
    mean = -55 + rng.normal(0, 3, NODES)[columns["node"]]
    rssi = mean - 26 * np.log10(columns["distance"] / 10) + 1.5 * error
    data = {n: jnp.asarray(v) for n, v in (columns | {"rssi": rssi}).items()}
    problem = Problem(nodes_heard, data, [], cluster="day")
    fitted = fitting.fit(problem, problem.null())
    projection = project(problem, fitted)
    drawn = replicate(problem, fitted, projection, jax.random.key(0), Settings())
    return locate(problem, fitted, projection, drawn, Settings())


def anywhere(error, _, rng):
    return np.where(rng.uniform(size=COUNT) < 0.04, 5.0, 1.0) * error


def in_a_burst(error, *_):
    """Six readings one after another are far off."""
    return error + 6.0 * ((np.arange(COUNT) >= 300) & (np.arange(COUNT) < 306))


def on_a_day(error, columns, _):
    return np.where(columns["day"] == 33, 5.0 * np.sign(error), error)


def at_a_node(error, columns, _):
    return np.where(columns["node"] == 7, 5.0, 1.0) * error


def test_a_few_far_readings_anywhere_are_tails_and_no_place():
    """4% of the errors are five times as large: one day's farthest reading was told as the spread of that day."""
    found = found_where(anywhere)
    first, *others = found.sites
    assert (first.site, first.moment) == ("rssi", "tails")
    assert first.p_value < 1e-9
    assert first.place is not None
    assert "readings that lie far out" in first.place
    assert min(other.p_value for other in others) > SURE
    assert found.site_p_value < 1e-9


def test_one_far_reading_is_told_by_its_place():
    found = found_where(lambda error, *_: error + 9.0 * (np.arange(COUNT) == 201)).sites
    assert found[0].moment != "tails"
    assert any(f.place == "row 201" for f in found if f.p_value < SURE)


@pytest.mark.parametrize(
    ("change", "sites", "place"),
    [
        (in_a_burst, {"mean"}, "day 33"),
        (on_a_day, {"rssi", "deviation"}, "day 33"),
        (at_a_node, {"rssi", "deviation"}, "node 7"),
    ],
)
def test_many_far_readings_at_one_place_are_told_by_it(change, sites, place):
    first, *others = found_where(change).sites
    assert first.site in sites
    assert not first.is_of_far
    assert place in f"{first.pattern}, {first.place}"
    assert [f.last for f in others if f.is_held] == [True]


@pytest.mark.parametrize("count", [60, 540])
def test_a_right_twin_has_few_far_readings_no_more_often_than_chance(count):
    """Of 1,500 data sets, refitted in mean and spread, no more than 2% have p < .01, nor .5% p < .001."""
    rng = np.random.default_rng(6)
    error = rng.normal(size=(1500, count))
    error -= error.mean(axis=1, keepdims=True)
    replicates = few(rng.normal(size=(4000, count)))
    data = few(error / error.std(axis=1, keepdims=True))
    family, found = Family("tails", Pattern("few", ()), np.ones(())), []
    for own in data:
        values = np.concatenate([own[None], replicates[rng.integers(0, len(replicates), 99)]])
        found.append(family_test(family, _but_farthest(values)).p_value)
    for level, most in ((0.01, 0.02), (0.001, 0.005)):
        assert stats.binom.sf(np.sum(np.array(found) < level) - 1, len(found), most) > 1e-3


@pytest.mark.parametrize(("of_values", "first"), [(0.2, "y"), (1e-4, "mean")])
def test_far_readings_come_last_where_a_site_is_wrong_without_them(of_values, first):
    """However sure they are: many readings that are off at one place lie far out among all."""
    mean = SiteFinding("mean", "additive", "node", of_values, 20.0)
    far = SiteFinding("y", "tails", "few", 1e-80, None, is_held=True)
    assert min(shadows_last([far, mean], 1.0), key=rank).site == first
