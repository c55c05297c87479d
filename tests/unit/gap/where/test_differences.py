"""Data less twin along columns, against means of groups, and its spread against the closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.bootstrap import replicate
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.where.differences import differences
from dtprob.models.complex_normal import ComplexNormal
from dtprob.models.declaration import model
from dtprob.report.axis_charts import difference_charts

ROWS, GROUPS, SIGMA = 240, 24, 2.0
RNG = np.random.default_rng(5)
PLACE = RNG.uniform(0.0, 1.0, ROWS)
KIND = RNG.integers(0, 3, ROWS)
NOISE = SIGMA * RNG.normal(size=ROWS)
BEYOND = 3.0 * (PLACE > 0.75)
GROUP = PLACE.argsort().argsort() * GROUPS // ROWS


@model(cluster="row", axes=dict.fromkeys(("square", "even", "fitted"), ("row",)))
def levelled(place, kind, count, y=None):
    """One unknown level, whatever the columns say."""
    numpyro.deterministic("square", place**2)
    numpyro.deterministic("even", jnp.ones(ROWS))
    level = numpyro.sample("level", dist.Normal(0.0, 100.0))
    numpyro.deterministic("fitted", level * place)
    with numpyro.plate("row", ROWS):
        numpyro.sample("y", dist.Normal(level, SIGMA), obs=y)


@model(cluster="row")
def powers(place, y=None):
    """The same, of powers."""
    level = numpyro.sample("level", dist.Normal(0.0, 100.0))
    with numpyro.plate("row", ROWS):
        numpyro.sample("y", dist.LogNormal(level, SIGMA), obs=y)


@model(cluster="row")
def phasors(place, y=None):
    """Complex values have no sign."""
    level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    with numpyro.plate("row", ROWS):
        numpyro.sample("y", ComplexNormal(jnp.full(ROWS, level + 0j), 1.0), obs=y)


def replicated(declared, data):
    problem = Problem(declared, {name: jnp.asarray(value) for name, value in data.items()}, [])
    fitted = fitting.fit(problem, problem.null())
    projection = project(problem, fitted)
    return problem, replicate(problem, fitted, projection, jax.random.key(0), Settings())


def found(declared, data):
    return {one.column: one for one in differences(*replicated(declared, data))}


@pytest.fixture(scope="module")
def of_levels():
    data = {"place": PLACE, "kind": KIND, "count": np.arange(ROWS), "y": 1.0 + NOISE + BEYOND}
    return found(levelled, data)


def means(values, group):
    centred = values - values.mean()
    return np.array([centred[group == g].mean() for g in np.unique(group)])


def test_they_are_means_of_groups_less_what_the_fit_took_up(of_levels):
    np.testing.assert_allclose(of_levels["place"].mean, means(NOISE + BEYOND, GROUP), atol=2e-3)
    np.testing.assert_allclose(of_levels["kind"].mean, means(NOISE + BEYOND, KIND), atol=2e-3)
    np.testing.assert_array_equal(of_levels["kind"].place, [0, 1, 2])
    assert np.all(np.diff(of_levels["place"].place) > 0)
    assert of_levels["place"].unit == ""


def test_their_spread_is_that_of_a_mean(of_levels):
    each = ROWS / GROUPS
    expected = SIGMA * np.sqrt((1 - each / ROWS) / each)
    assert abs(of_levels["place"].spread.mean() / expected - 1) < 0.05
    assert of_levels["place"].largest > 4


def test_columns_are_numbers_and_few_kinds_and_what_comes_from_the_data_alone(of_levels):
    assert set(of_levels) == {"place", "kind", "count", "square"}
    np.testing.assert_allclose(of_levels["square"].mean, of_levels["place"].mean)
    assert next(iter(of_levels)) in {"place", "square"}


def test_of_powers_they_are_in_decibels():
    logarithm = 1.0 + NOISE + BEYOND
    one = found(powers, {"place": PLACE, "y": np.exp(logarithm)})["place"]
    np.testing.assert_allclose(one.mean, 10 / np.log(10) * means(logarithm, GROUP), atol=1e-2)
    assert one.unit == "dB"


def test_columns_with_ties_are_taken_as_they_are():
    place = np.maximum(PLACE, 0.7)
    seen = found(levelled, {"place": place, "kind": KIND, "count": np.arange(ROWS), "y": 1.0 + NOISE})
    assert set(seen) == {"place", "kind", "count", "square"}
    tied = PLACE <= 0.7
    assert np.isclose(seen["place"].mean[0], (NOISE - NOISE.mean())[tied].mean(), atol=2e-3)
    assert seen["place"].place[0] == 0.7 < seen["place"].place[1]


@model(cluster="row")
def each_kind(place, kind, y=None):
    """A level for each kind; what is not seen is masked."""
    level = numpyro.sample("level", dist.Normal(jnp.zeros(3), 1e4).to_event(1))
    with numpyro.plate("row", ROWS):
        seen = dist.Normal(level[kind], SIGMA).mask(place < 0.75)
        numpyro.sample("y", seen, obs=y)


def test_groups_that_say_nothing_are_left_out():
    seen = found(each_kind, {"place": PLACE, "kind": KIND, "y": 1.0 + NOISE})
    assert set(seen) == {"place"}  # each kind's mean is fitted
    assert seen["place"].place.max() < 0.76
    assert len(seen["place"].place) in {18, 19}


@model(cluster="link", axes={"level": ("link",)})
def of_two_observations(where, weight, y=None, z=None):
    """Links with several values each, and another one of the same level."""
    level = numpyro.deterministic("level", numpyro.sample("height", dist.Normal(0.0, 100.0)) * jnp.ones(40))
    with numpyro.plate("link", 40, dim=-2), numpyro.plate("tap", 6, dim=-1):
        numpyro.sample("y", dist.Normal(level[:, None], SIGMA), obs=y)
    with numpyro.plate("link", 40, dim=-1):
        numpyro.sample("z", dist.Normal(level, SIGMA), obs=z)


def test_each_observation_has_its_own_and_columns_of_all_its_axes_count():
    weight = PLACE.reshape(40, 6)
    y, z = SIGMA * RNG.normal(size=(40, 6)) + 3.0 * (weight > 0.75), SIGMA * RNG.normal(size=40)
    where = np.arange(40.0)
    data = {"where": where, "weight": weight, "y": y, "z": z}
    problem, drawn = replicated(of_two_observations, data)
    seen = {(one.observed, one.axis, one.column): one for one in differences(problem, drawn)}
    assert set(seen) == {("y", "", "weight"), ("y", "link", "where"), ("z", "link", "where")}
    level = np.concatenate([y.ravel(), z]).mean()
    expected = [(y - level).ravel()[g == GROUP].mean() for g in range(GROUPS)]
    np.testing.assert_allclose(seen["y", "", "weight"].mean, expected, atol=5e-3)
    of_z = seen["z", "link", "where"]
    nearest = np.abs(where[:, None] - of_z.place).argmin(axis=1)
    np.testing.assert_allclose(of_z.mean, [(z - level)[nearest == g].mean() for g in range(4)], atol=5e-3)


def test_complex_values_have_none():
    assert found(phasors, {"place": PLACE, "y": NOISE + 1j * NOISE[::-1]}) == {}


def test_they_are_drawn_with_their_unit_and_largest_place():
    said = {"observed": "y", "column": "distance_m", "unit": "dB", "of": 3}
    values = {
        "place_0": ("group_0", np.array([1.0, 2.0, 3.0]), said),
        "before_0": ("group_0", np.array([0.1, -4.0, 0.2]), said),
        "spread_0": ("group_0", np.full(3, 0.5), said),
    }
    tree = xr.DataTree.from_dict({"/differences": xr.Dataset(values)})
    report = {"gap": {"after": None}, "provenance": {}}
    (chart,) = difference_charts(report, tree)  # pyright: ignore[reportArgumentType]
    assert "−4.00 at 2.00" in chart.svg
    assert "Data less twin (dB)" in chart.svg
