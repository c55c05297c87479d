"""Site families: patterns are linear and their scores adjoint to what they perturb; curves are what their labels say."""

from functools import partial
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.gap.model.inline import unnamed
from dtprob.gap.model.problem import Problem
from dtprob.gap.where.along import curves
from dtprob.gap.where.curves import Curves, cycles, grouped
from dtprob.gap.where.families import Family, Pattern, Summed, deterministic, families, observed, shifted
from dtprob.gap.where.family_test import family_test
from dtprob.gap.where.quantities import Quantity, groups, quantity
from tests.unit.gap.examples import bend, draw, line

LENGTH = 40


def table(x, street, place, y=None):
    """A line over rows that lie in streets, at places."""
    del street, place
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    with numpyro.plate("row", len(x)):
        mean = numpyro.deterministic("mean", slope * x)
        numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)


def raw(x, y=None):
    """A line that names no site."""
    slope = numpyro.sample("b", dist.Normal(0.0, 3.0))
    with numpyro.plate("row", len(x)):
        numpyro.sample("y", dist.Normal(slope * x, 1.0), obs=y)


def rows(seed=1):
    rng = np.random.default_rng(seed)
    return {
        "x": jnp.asarray(rng.normal(size=LENGTH)),
        "street": jnp.asarray(np.repeat(np.arange(5), 8)[rng.permutation(LENGTH)]),
        "place": jnp.asarray(rng.normal(size=(LENGTH, 2))),
        "y": jnp.asarray(rng.normal(size=LENGTH)),
    }


@pytest.fixture(scope="module")
def problem():
    return Problem(table, rows(), [bend()], "row")


def complex_site(problem, shape=(LENGTH, 3), axes=("row", "antenna")):
    rng = np.random.default_rng(3)
    value = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    gradients = rng.normal(size=(4, *shape)) + 1j * rng.normal(size=(4, *shape))
    return deterministic("gain", axes, value, gradients)


@pytest.mark.parametrize("shape", [(LENGTH, 3), (LENGTH, 8)], ids=["short", "rows in order"])
def test_scores_are_the_slope_along_what_a_family_perturbs(problem, shape):
    site = complex_site(problem, shape)
    angle = quantity("angle", site.axes, np.random.default_rng(4).normal(size=shape))
    seen = set()
    for family, scores in families(partial(curves, problem), [(angle, tuple(angle.curves()))], site):
        step = family.step(scores[0], np.ones(scores.shape[1]), site.value)
        slope = np.real(np.sum(site.gradients * step, axis=(1, 2)))  # d = Re(g dz), as JAX has it
        np.testing.assert_allclose(slope, scores @ scores[0], rtol=1e-6, atol=1e-9)
        seen.add(family.kind)
    assert seen == {
        "additive",
        "relative",
        "conjugate",
        *(f"from the {side} {axis}" for side in ("next", "last") for axis in ("row", "antenna")),
        *(["image along antenna"] if shape[1] > 5 else []),
    }


@pytest.mark.parametrize("users", [(), (3,)])
def test_a_column_may_act_on_each_entry_of_a_short_last_axis_otherwise(problem, users):
    """Of two options, the odds of one rise with x as those of the other fall: a sum over options is blind to it."""
    rng = np.random.default_rng(4)
    shape = (*users, LENGTH, 2)
    value, x = rng.normal(size=shape), np.asarray(problem.data["x"])
    gradients = rng.normal(size=(60, *shape))
    gradients -= gradients.mean(axis=-1, keepdims=True)
    gradients[0] += 0.8 * x[:, None] * np.array([1.0, -1.0])
    site = deterministic("utility", ("user", "row", "option")[-len(shape) :], value, gradients)
    found = {f.label: family_test(f, scores) for f, scores in families(partial(curves, problem), [], site)}
    assert found["additive, along x"].p_value > 0.01
    assert found["additive, along x x option"].p_value < 1e-3


def test_a_mirror_frequency_leaks_into_an_entry(problem):
    site = complex_site(problem, (LENGTH, 8), ("row", "subcarrier"))
    found = {family.label: family for family, _ in families(partial(curves, problem), (), site)}
    step = found["image along subcarrier, common"].step(np.array([1.0, 0.0]), np.ones(2), site.value)
    np.testing.assert_allclose(step, site.value[:, ::-1].conj())


def test_a_neighbour_leaks_into_an_entry(problem):
    site = complex_site(problem)
    found = {family.label: family for family, _ in families(partial(curves, problem), (), site)}
    step = found["from the next antenna, common"].step(np.array([1.0, 0.0]), np.ones(2), site.value)
    np.testing.assert_allclose(step, np.roll(site.value, -1, axis=1))


def test_curves_are_smooth_ripples_columns_and_groups(problem):
    given = curves(problem, "row", LENGTH)
    found = {c.label: c.values for c in given}
    ripples = [c.values for c in given if c.ripple is not None and c.ripple.over == "row"]
    waves = np.concatenate([found["smooth in row"], *ripples])
    np.testing.assert_allclose(waves @ waves.T, LENGTH / 2 * np.eye(LENGTH - 1), atol=1e-9)
    assert found["by street"].shape == (5, LENGTH)
    np.testing.assert_array_equal(found["by street"].toarray().sum(0), 1.0)
    assert {"along x", "along place[0]", "along place[1]", "over place[0] and place[1]"} <= set(found)
    assert {c.label: c.column for c in given if c.column is not None} == {"by street": "street"}
    assert not any("y" in name.split()[1:] for name in found)
    order = np.argsort(np.asarray(problem.data["x"]))
    assert np.all(np.diff(found["along x"][0][order]) < 0)


def test_a_table_of_features_is_looked_along_whole(problem):
    """Of more than three columns, which were taken for no positions, none was looked along."""
    rng = np.random.default_rng(6)
    wide = SimpleNamespace(
        declaration=problem.declaration,
        data={"features": rng.normal(size=(LENGTH, 7))},
        observed=problem.observed,
    )
    labels = {c.label for c in curves(wide, "row", LENGTH)}
    assert {f"along features[{i}]" for i in range(7)} <= labels


def test_real_numbers_that_repeat_are_looked_at_by_value_too(problem):
    receiver = np.repeat(np.arange(8.0), 10)
    named = SimpleNamespace(
        declaration=problem.declaration, data={"receiver": receiver}, observed=problem.observed
    )
    found = {c.label: c for c in curves(named, "row", 80)}
    assert found["by receiver"].extent == (8, 80)
    assert "along receiver" in found


def test_compact_regions_of_two_columns_are_groups_of_neighbours(problem):
    found = {c.label: c for c in curves(problem, "row", LENGTH)}
    near = found["near a place of place[0] and place[1]"]
    assert near.overlaps
    place = np.asarray(problem.data["place"])
    unit = (place - place.mean(0)) / place.std(0)
    for group in near.values.toarray()[-near.values.shape[0] // 4 :] > 0:
        assert group.sum() == LENGTH // 4
        apart = np.linalg.norm(unit[group][:, None] - unit[None], axis=-1)
        # about one of its members it holds all that are nearest
        assert any(set(np.argsort(row)[: group.sum()]) == set(np.flatnonzero(group)) for row in apart)


def test_columns_of_a_grid_are_looked_over_together(problem):
    grid = np.stack(np.meshgrid(np.arange(24.0), np.arange(24.0)), axis=-1).reshape(-1, 2)
    named = SimpleNamespace(
        declaration=problem.declaration,
        data={"east": grid[:, 0], "north": grid[:, 1]},
        observed=problem.observed,
    )
    labels = {c.label for c in curves(named, "row", len(grid))}
    assert {"over east and north", "near a place of east and north", "by east", "along east"} <= labels


def test_what_is_known_of_each_entry_is_no_table_of_features(problem):
    """Readings (40, 6) with a weight each have one column of weights, not six."""
    shape = (LENGTH, 6)
    both = SimpleNamespace(
        declaration=SimpleNamespace(
            observed={"y": SimpleNamespace(axes=("row", "place"), shape=shape)},
            sites=problem.declaration.sites,
        ),
        data={"weight": np.random.default_rng(7).normal(size=shape)},
        observed=problem.observed,
    )
    assert not any("weight" in c.label for c in curves(both, "row", LENGTH))


def test_a_band_of_ripples_is_called_by_its_half_waves(problem):
    found = {c.label: c for c in curves(problem, "row", LENGTH)}
    whole = found["ripple in row, 9 to 16 half waves"]
    band = whole.band(2, 5)
    assert band.label == "ripple in row, 11 to 13 half waves"
    np.testing.assert_array_equal(band.values, whole.values[2:5])
    assert band.band(1, 2).label == "ripple in row, 12 to 12 half waves"
    with pytest.raises(ValueError, match="no ripple"):
        found["smooth in row"].band(0, 1)


def test_a_column_of_an_axis_name_stands_for_its_positions(problem):
    place = np.random.default_rng(5).uniform(size=LENGTH)
    named = SimpleNamespace(
        declaration=problem.declaration,
        data={**problem.data, "row": place},
        observed=problem.observed,
    )
    labels = [c.label for c in curves(named, "row", LENGTH)]
    assert len(labels) == len(set(labels))
    ripple = next(c for c in curves(named, "row", LENGTH) if c.ripple is not None)
    scaled = (place - place.min()) / np.ptp(place)
    np.testing.assert_allclose(ripple.values[0], np.cos(5 * np.pi * scaled), atol=1e-12)


def test_a_quantity_lies_on_the_axes_along_which_it_varies():
    values = np.linspace(0, 1, LENGTH)[:, None, None] + np.linspace(0, 3, 4) + np.zeros((LENGTH, 3, 1))
    found = quantity("delay", ("link", "antenna", "path"), values)
    assert found.axes == ("link", "path")
    np.testing.assert_array_equal(found.values, values[:, 0])
    assert found.kept(("link", "antenna", "path"), (LENGTH, 3, 4)) == (0, 2)
    assert found.kept(("link", "path"), (LENGTH, 4)) == (0, 1)
    assert found.kept(("path", "link"), (4, LENGTH)) is None
    assert found.kept(("link", "path"), (LENGTH, 5)) is None
    assert found.kept(("link", "antenna"), (LENGTH, 3)) is None
    unnamed = quantity("level", ("level_dim_0",), np.arange(9.0))
    assert unnamed.kept(("power_dim_0",), (9,)) == (0,)
    square = Quantity("phase", ("receiver", "transmitter"), np.ones((4, 4)))
    assert square.kept(("transmitter", "receiver"), (4, 4)) is None  # as many, but others
    assert square.kept(("receiver", "power_dim_1"), (4, 4)) == (0, 1)
    assert quantity("device", ("link",), np.arange(9)) is None
    assert quantity("height", ("link",), np.array([1.5, 10.0] * 9)) is None
    assert quantity("gain", ("link",), np.full(9, np.nan)) is None


def test_curves_over_a_quantity_are_smooth_in_its_rank_and_ripples_over_its_values():
    values = np.random.default_rng(0).lognormal(size=(LENGTH, 3))
    smooth, steps, bends, between, *ripples = quantity("delay", ("link", "path"), values).curves()
    order = np.argsort(values.reshape(-1))
    assert smooth.label == "along delay"
    assert np.all(np.diff(smooth.values[0][order]) < 0)
    assert steps.label == "beyond a value of delay"
    assert steps.places[7] == f"beyond {np.median(values):.4g} of delay"
    assert np.all(np.diff(steps.values[:, order]) >= 0)
    np.testing.assert_allclose(steps.values.mean(1), 0.5 - np.arange(1, 16) / 16, atol=1 / values.size)
    assert bends.label == "bend at a value of delay"
    assert bends.places[7] == f"bend at {np.median(values):.4g} of delay"
    bend = bends.values[7] - bends.values[7].min()
    above = np.maximum(values.reshape(-1) - np.median(values), 0.0)
    np.testing.assert_allclose(bend * above.std() * 2**0.5, above, atol=1e-12)
    assert between.label == "between two values of delay"
    low, high = map(float, between.places[70].removeprefix("delay ").split(" to "))
    inside = between.values[[70]].toarray()[0] > 0
    assert inside.sum() == pytest.approx(values.size / 16, abs=4)
    np.testing.assert_array_equal(values.reshape(-1)[inside].min(), pytest.approx(low, rel=1e-3))
    np.testing.assert_array_equal(values.reshape(-1)[inside].max(), pytest.approx(high, rel=1e-3))
    outside = values.reshape(-1)[~inside]
    assert not ((outside > 1.001 * low) & (outside < 0.999 * high)).any()
    scaled = (values.reshape(-1) - values.min()) / np.ptp(values)
    np.testing.assert_allclose(ripples[0].values[1], np.cos(6 * np.pi * scaled), atol=1e-12)
    assert ripples[-1].label.endswith("to 64 half waves")


def test_cycles_of_each_period_take_turns():
    found = cycles(150, "slot")
    assert [c.label for c in found] == [f"every {period} along slot" for period in range(2, 7)]
    for period, one in enumerate(found, start=2):
        phases = one.values.toarray()
        np.testing.assert_array_equal(phases.argmax(0), np.arange(150) % period)
        np.testing.assert_array_equal(phases.sum(0), 1.0)
    assert cycles(47, "slot") == ()


def test_a_block_of_days_and_hours_is_noticed_where_no_stretch_of_one_day_is():
    """Six days by seven hours, 1.3 standard deviations: 3.4 over the hours of one day, 8.4 over all."""
    rng = np.random.default_rng(8)
    gradients = rng.normal(size=(200, 50, 24))
    gradients[0, 20:26, 17:24] += 1.3
    site = deterministic("level", ("day", "hour"), np.ones((50, 24)), gradients)
    found = {f.label: family_test(f, s) for f, s in families(lambda *_: (), (), site)}
    assert found["additive, block of day and hour"].p_value < 1e-4
    assert (
        found["additive, stretch of hour x day"].p_value
        > 1e3 * found["additive, block of day and hour"].p_value
    )
    longer = deterministic("level", ("day", "hour"), np.ones((400, 24)), rng.normal(size=(3, 400, 24)))
    assert not any("block" in f.label for f, _ in families(lambda *_: (), (), longer))


def test_a_cycle_goes_on_from_cluster_to_cluster(problem):
    value = np.zeros((21, 8, 2))
    value.reshape(168, 2)[::7, 1] = 1.0
    site = deterministic("load", ("window", "slot", "device"), np.zeros(value.shape), value[None])
    found = {f.label: (f, s) for f, s in families(partial(curves, problem), (), site)}
    family, scores = found["additive, every 7 along window and slot"]
    assert np.count_nonzero(scores) == 1
    step = family.step(scores[0], np.full(scores.shape[1], 24.0), site.value)
    np.testing.assert_allclose(step, value, atol=1e-12)


def test_a_cycle_of_a_few_clusters_own_is_noticed_where_none_of_them_shows_it():
    """Six cells of thirty in four hours of each of seven days, 1.2 standard deviations."""
    rng = np.random.default_rng(9)
    gradients = rng.normal(size=(200, 30, 168))
    gradients[0, ::5] += 1.2 * (np.arange(168) % 24 >= 20)
    site = deterministic("load", ("cell", "hour"), np.ones((30, 168)), gradients)
    found = {f.label: family_test(f, s) for f, s in families(lambda *_: (), (), site)}
    own = found["additive, every 24 along hour x cell"]
    assert own.variance.shape == (720,)
    assert own.p_value < 1e-8
    assert found["additive, stretch of hour x cell"].p_value > 100 * own.p_value
    step = own.family.step(own.first[0], own.variance, site.value)
    np.testing.assert_allclose(step[:, :24], step[:, 144:], atol=1e-12)
    assert np.corrcoef(step[::5, :24].mean(0), np.arange(24) >= 20)[0, 1] > 0.8


@pytest.mark.parametrize("turned", [False, True])
def test_what_a_group_does_at_some_hours_is_noticed(turned):
    """The cells of one of five vendors at four hours of forty, two standard deviations; either axis first."""
    rng = np.random.default_rng(10)
    vendor = np.arange(30) % 5
    gradients = rng.normal(size=(200, 30, 40))
    gradients[0][np.ix_(vendor == 3, np.arange(17, 21))] += 2.0
    words = tuple(f"vendor {k}" for k in range(5))
    by = Curves("by vendor", grouped(vendor), column="vendor", plain=True, places=words)
    smooth = Curves("smooth in hour", np.cos(np.pi * np.outer(np.arange(1, 5), np.arange(40) + 0.5) / 40))
    along = {"cell": (by,), "hour": (smooth,)}
    axes = ("cell", "hour")
    if turned:
        gradients, axes = np.swapaxes(gradients, 1, 2), axes[::-1]
    site = deterministic("load", axes, np.ones(gradients.shape[1:]), gradients)
    found = {f.label: family_test(f, s) for f, s in families(lambda axis, _: along[axis], (), site)}
    each, course = found["additive, by vendor x hour"], found["additive, smooth in hour by vendor"]
    some = found["additive, stretch of hour by vendor"]
    assert some.p_value < 1e-6 * min(each.p_value, course.p_value)
    assert set(some.pattern.split(", ")) == {"vendor 3", "hour 17 to 18"}
    assert each.variance.shape == (200,)
    assert course.variance.shape == (20,)
    assert each.p_value < 1e-2
    assert course.p_value < 1e-2
    place = each.family.pattern.curves.places[int(np.argmax(each.first[0]))]
    vendor_3, hour = sorted(place.split(", "), reverse=True)
    assert vendor_3 == "vendor 3"
    assert int(hour.removeprefix("hour ")) in range(17, 21)
    step = each.family.step(each.first[0], each.variance, site.value)
    step = step.T if turned else step
    assert (step[3] == step[8]).all()
    assert step[3, 17:21].mean() > 0.5


def test_each_of_a_few_clusters_may_follow_a_column_of_the_other_axis_in_its_own_way():
    """One cell of six is off in the first hours of each day, by two standard deviations; no other is."""
    rng = np.random.default_rng(12)
    hour = np.arange(120) % 24
    gradients = rng.normal(size=(200, 6, 120))
    gradients[0, 4] -= 2.0 * (hour < 5)
    words = tuple(f"hour {h}" for h in range(24))
    by = Curves("by hour", grouped(hour), column="hour", plain=True, places=words)
    site = deterministic("load", ("cell", "time"), np.ones((6, 120)), gradients)
    along = {"cell": (), "time": (by,)}
    found = {f.label: family_test(f, s) for f, s in families(lambda axis, _: along[axis], (), site)}
    own = found["additive, by hour x cell"]
    assert own.p_value < 1e-3 < found["additive, by hour"].p_value
    places = own.family.pattern.curves.places
    assert places[int(own.told.argmax())].startswith("cell 4, hour ")


def test_a_while_of_one_entry_of_a_third_axis_is_noticed():
    """One sensor of three, in twelve tracks, from the 20th of 50 steps to the 34th."""
    rng = np.random.default_rng(13)
    gradients = rng.normal(size=(200, 12, 50, 3))
    gradients[0, :, 20:35, 2] += 0.6
    site = deterministic("mean", ("track", "time", "sensor"), np.ones((12, 50, 3)), gradients)
    found = {f.label: family_test(f, s) for f, s in families(lambda *_: (), (), site)}
    some = found["additive, stretch of time x sensor"]
    assert some.p_value < 1e-6 < found["additive, time x sensor"].p_value
    together = gradients.copy()
    together[0, :, 20:35, :2] += 0.6
    site = deterministic("mean", ("track", "time", "sensor"), np.ones((12, 50, 3)), together)
    found = {f.label: family_test(f, s) for f, s in families(lambda *_: (), (), site)}
    assert found["additive, stretch of time"].p_value < 1e-12


def test_what_whole_numbers_tell_apart_is_told_of_each_outcome(problem):
    """What a device did last tilts the odds between its outcomes, which sum to nothing over them."""
    rng = np.random.default_rng(5)
    last = rng.integers(0, 2, (30, 10, 2))
    gradients = rng.normal(size=(60, 30, 10, 2, 2))
    gradients[0] += 0.3 * np.where(last == 1, 1.0, -1.0)[..., None] * np.array([-1.0, 1.0])
    site = deterministic(
        "odds", ("window", "slot", "device", "outcome"), np.ones(gradients.shape[1:]), gradients
    )
    over = [(q, tuple(q.curves())) for q in groups("last", site.axes[:3], last)]
    found = {f.label: family_test(f, s) for f, s in families(partial(curves, problem), over, site)}
    each = found["additive, by value of last of each device x outcome"]
    assert each.variance.shape == (8,)
    assert each.p_value < 1e-12
    assert found["additive, by value of last of all x device x outcome"].variance.shape == (16,)
    assert found["additive, by value of last of each device"].p_value > 1e-3
    step = each.family.step(each.first[0], each.variance, site.value)
    assert np.corrcoef(step.ravel(), (gradients[0] - gradients[1:].mean(0)).ravel())[0, 1] > 0.2


def test_short_axes_have_no_curves(problem):
    assert curves(problem, "antenna", 5) == ()


def test_the_spread_of_an_observation_is_a_site(problem):
    x = problem.null()
    sites = list(observed(problem, problem.compiled.residual(x)[None], ()))
    assert [(s.name, list(s.kinds)) for s in sites] == [("y", ["spread"])]
    y = np.asarray(problem.data["y"])
    np.testing.assert_allclose(sites[0].gradients[0], (y**2 - 1) / np.sqrt(2), rtol=1e-5)
    step = np.random.default_rng(0).normal(size=(1, LENGTH))
    moved = problem.rows.unstack(np.asarray(shifted(problem, x, sites[0], step)))
    np.testing.assert_allclose(moved[0], np.concatenate([np.zeros(LENGTH), step[0]]), rtol=1e-6)


def test_where_no_site_is_named_the_observations_locations_are_tested():
    problem = Problem(raw, {n: rows()[n] for n in ("x", "y")}, [], "row")
    own = unnamed(problem, problem.null())
    assert own == {"y"}
    sites = list(observed(problem, problem.compiled.residual(problem.null())[None], own))
    assert [list(s.kinds) for s in sites] == [["location"], ["spread"]]
    y = np.asarray(problem.data["y"])
    np.testing.assert_allclose(sites[0].gradients[0], y, rtol=1e-5)


def test_rows_go_back_to_where_they_were_observed():
    problem = Problem(line, draw("line"), [bend()])
    flat = np.arange(2.0 * 12 * 8)
    values = {"y": jnp.asarray(flat.reshape(2, 12, 8))}
    np.testing.assert_array_equal(problem.rows.unstack(np.asarray(problem.rows.stack(values))), flat)
    assert SimpleNamespace(**problem.located).y == 1


def test_a_measured_column_of_few_values_makes_groups_and_no_ripples():
    """Storeys as 0.0, 1.0, 2.0: ripples over three values are the same few curves again and again."""
    floor = jnp.asarray(np.arange(LENGTH) % 3, float)
    found = curves(Problem(table, {**rows(), "place": floor}, [bend()], "row"), "row", LENGTH)
    of_floor = [c for c in found if "place" in c.label]
    assert {c.label for c in of_floor} >= {"by place", "along x by place"}
    of_its_values = [c for c in of_floor if not c.label.endswith("by place")]
    assert not any(c.ripple is not None or c.overlaps for c in of_its_values)


def test_ripples_are_no_finer_than_the_values_are_many():
    eight = jnp.asarray(np.arange(LENGTH) % 8, float)
    found = curves(Problem(table, {**rows(), "place": eight}, [bend()], "row"), "row", LENGTH)
    bands = [c for c in found if c.ripple is not None and c.ripple.over == "place"]
    assert sum(c.extent[0] for c in bands) == 3  # half waves 5 to 7, beyond the smooth ones
    waves = np.concatenate([c.values for c in found if c.label == "along place" or c in bands])
    distinct = np.unique(waves, axis=1)
    assert distinct.shape[1] == 8
    assert np.linalg.matrix_rank(distinct) == 8


def test_what_bends_at_a_value_is_told_as_a_bend():
    """Levels that fall twice as fast beyond a breakpoint distance: a step anywhere says less."""
    rng = np.random.default_rng(6)
    distance = np.sort(rng.uniform(10.0, 400.0, 600))
    scores = rng.normal(size=(200, 600))
    scores[0] -= 0.006 * np.maximum(distance - 250.0, 0.0)
    found = {c.label: c for c in quantity("distance", ("row",), distance).curves()}
    tests = {
        label: family_test(
            Family("additive", pattern, np.ones(())), pattern.scores(Summed(scores[..., None]))
        )
        for label, pattern in ((n, Pattern(n, (0,), c)) for n, c in found.items())
    }
    bend = tests["bend at a value of distance"]
    assert bend.p_value < min(1e-6, tests["beyond a value of distance"].p_value)
    assert float(bend.pattern.split()[2]) == pytest.approx(250.0, abs=40.0)


@pytest.mark.parametrize(
    "column", [np.minimum(np.arange(600.0), 20.0), np.maximum(np.arange(600.0) - 300.0, 0.0)]
)
def test_bends_at_the_ends_of_a_column_are_none(column):
    """A meter at its end tells of no bend there, and a bend where a column begins is a line."""
    found = [c for c in quantity("meter", ("row",), column).curves() if c.label.startswith("bend")]
    assert all(c.extent[0] == len(c.places) > 0 for c in found)
    assert not any(
        place == f"bend at {end:.4g} of meter"
        for c in found
        for place in c.places
        for end in (column.min(), column.max())
    )
