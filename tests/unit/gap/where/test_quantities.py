"""Ways to vary over what a model computes: by value where it takes few values, as entries of a table are."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import sparse

from dtprob.gap.where.along import curves
from dtprob.gap.where.data_columns import all_columns, whole_columns
from dtprob.gap.where.families import Family, Pattern, Summed
from dtprob.gap.where.family_test import family_test
from dtprob.gap.where.quantities import cells, groups, of_each, quantity, together


@pytest.fixture
def table():
    """Entries of a table of seven, looked up at 40 places of 10 links."""
    rng = np.random.default_rng(0)
    entries = rng.permutation(np.linspace(-1.0, 2.0, 7))
    return entries[rng.integers(0, 7, (10, 40))]


def by_value(values):
    found = quantity("law", ("link", "place"), values)
    assert found is not None
    return [curves for curves in found.curves() if curves.label == "by value of law"]


def test_what_takes_few_values_may_be_off_at_each(table):
    (curves,) = by_value(table)
    groups = curves.values.toarray() if sparse.issparse(curves.values) else curves.values
    assert groups.shape == (7, 400)
    np.testing.assert_array_equal(groups.sum(axis=0), 1.0)
    for group in groups:
        assert len(np.unique(table.reshape(-1)[group > 0])) == 1


def test_what_takes_many_values_has_none_of_its_own(table):
    assert not by_value(table + 1e-9 * np.arange(400).reshape(10, 40))


def test_whole_numbers_on_several_axes_make_groups_of_each_and_of_all():
    rng = np.random.default_rng(1)
    did = rng.integers(0, 2, (5, 60, 3))
    anywhere, each, together = groups("did", ("episode", "slot", "device"), did)
    (by_itself,) = anywhere.curves()
    assert by_itself.label == "by value of did"
    assert by_itself.values.toarray().reshape(2, 5, 60, 3)[1].tolist() == did.tolist()
    assert each.axes == ("episode", "slot", "device")
    assert together.axes == ("episode", "slot")
    (by_device,), (by_all,) = each.curves(), together.curves()
    assert by_device.label == "by value of did of each device"
    of_device = by_device.values.toarray().reshape(6, 5, 60, 3)
    for group in of_device:
        (device,) = np.unique(np.nonzero(group)[2])
        assert len(np.unique(did[..., device][group[..., device] > 0])) == 1
    assert by_all.values.shape == (8, 300)
    for group in by_all.values.toarray().reshape(8, 5, 60):
        assert len(np.unique(did[group > 0], axis=0)) == 1


def test_groups_are_of_whole_numbers_that_come_often():
    assert not list(groups("level", ("link", "place"), np.zeros((10, 40))))
    assert not list(groups("device", ("link",), np.arange(10)))
    assert not list(groups("valid", ("link", "place"), np.ones((10, 40), bool)))
    (anywhere, each, together) = groups("code", ("link", "place"), np.arange(400).reshape(200, 2))
    assert next(anywhere.curves()).label == "along code"  # so many that near ones may act alike
    assert not list(each.curves())
    assert not list(together.curves())


def test_flags_stored_as_real_numbers_make_groups_too():
    shut = np.random.default_rng(2).integers(0, 2, (10, 40))
    stored, whole = (list(groups("shut", ("link", "place"), shut.astype(kind))) for kind in (float, int))
    assert (
        [q.name for q in stored] == [q.name for q in whole] == ["shut", "shut of each place", "shut of all"]
    )
    assert not list(groups("level", ("link", "place"), np.random.default_rng(3).normal(size=(10, 40))))


def test_columns_that_are_broadcast_lie_on_the_observations_axes():
    seen, name = np.zeros((2, 8, 6)), "shut"
    for shape, found in (((8, 6), True), ((2, 1, 6), True), ((1, 6), True), ((8, 5), False), ((6,), False)):
        column = np.arange(np.prod(shape)).reshape(shape)
        problem = SimpleNamespace(data={name: column}, observed=SimpleNamespace(arguments=frozenset()))
        got = whole_columns(problem, SimpleNamespace(shape=seen.shape))
        assert (name in got) == found
        if found:
            np.testing.assert_array_equal(got[name], np.broadcast_to(column, seen.shape))


def curves_of(**columns):
    size = len(next(iter(columns.values())))
    observed = {"y": SimpleNamespace(axes=("row",), shape=(size,))}
    declaration = SimpleNamespace(observed=observed)
    problem = SimpleNamespace(
        data=columns, observed=SimpleNamespace(arguments=frozenset()), declaration=declaration
    )
    return {found.label: found for found in curves(problem, "row", size)}


def pairs(**columns):
    return {label: found.values for label, found in curves_of(**columns).items()}


def test_two_columns_of_whole_numbers_make_cells():
    band, day = np.repeat(np.arange(3), 40), np.tile(np.arange(4), 30)
    cells = pairs(band=band, day=day)["by band and day"].toarray()
    assert cells.shape == (12, 120)
    assert {(b, d) for row in cells for b, d in zip(band[row > 0], day[row > 0], strict=True)} == {
        (b, d) for b in range(3) for d in range(4)
    }
    assert all(len({*zip(band[row > 0], day[row > 0], strict=True)}) == 1 for row in cells)
    assert "by band and part" not in pairs(band=band, part=2 * band + day % 2)  # parts of bands
    assert "by band and day" not in pairs(band=band[::3], day=np.arange(40) // 2)  # hardly a reading in each


def test_a_line_along_one_column_may_differ_by_another():
    rng = np.random.default_rng(4)
    band, distance = np.repeat(np.arange(3), 40), rng.uniform(size=120)
    lines = pairs(band=band, distance=distance)["along distance by band"].toarray()
    assert lines.shape == (3, 120)
    for b, line in enumerate(lines):
        assert not line[band != b].any()
        assert abs(np.corrcoef(line[band == b], distance[band == b])[0, 1]) == pytest.approx(1.0)


def test_every_two_of_a_dozen_columns_are_looked_over_together():
    """What two features of a regression do together is the commonest term that one lacks; compact places are of a few."""
    rng = np.random.default_rng(9)
    found = curves_of(**{f"f{i}": rng.normal(size=400) for i in range(12)})
    assert sum(label.startswith("over ") for label in found) == 66
    assert sum(label.startswith("near a place") for label in found) == 6
    products = found["product of two columns"]
    assert products.overlaps
    assert products.extent == (66, 400)
    assert products.places[-1] == "f10 times f11"


def test_a_product_of_two_columns_is_told_from_all_others():
    rng = np.random.default_rng(10)
    columns = {f"f{i}": rng.normal(size=3000) for i in range(8)}
    products = curves_of(**columns)["product of two columns"]
    scores = rng.normal(size=(200, 3000))
    scores[0] += 0.12 * columns["f1"] * columns["f5"]  # 6.6 standard deviations
    pattern = Pattern(products.label, (0,), products)
    found = family_test(Family("additive", pattern, np.ones(())), pattern.scores(Summed(scores[..., None])))
    assert found.p_value < 1e-6
    assert found.pattern == "f1 times f5"


def test_a_group_may_differ_between_two_values_of_a_column_or_for_a_while():
    """As a sector does in the shadow of something, or a receiver while it was broken."""
    rng = np.random.default_rng(4)
    band, distance = rng.integers(0, 3, 480), rng.uniform(size=480)
    found = curves_of(band=band, distance=distance)
    for label, along in (
        ("between two values of distance by band", distance),
        ("stretch of row by band", np.arange(480)),
    ):
        some = found[label]
        assert some.overlaps
        for words, inside in zip(some.places[::40], some.values.toarray()[::40] > 0, strict=True):
            group, ends = words.split(", ")
            low, high = (float(word) for word in ends.split(" ", 1)[1].split(" to "))
            within = (along >= 0.999 * low) & (along <= 1.001 * high)
            np.testing.assert_array_equal(inside, within & (band == int(group.removeprefix("band "))))


def test_whole_numbers_that_only_rise_are_a_line_too():
    """What some access points do since some day has too few readings in each cell of both."""
    rng = np.random.default_rng(4)
    day, point = np.sort(rng.integers(0, 20, 300)), rng.integers(0, 30, 300)
    found = pairs(day=day, point=point)
    assert "by point and day" not in found
    lines = found["along day by point"].toarray()
    assert lines.shape == (30, 300)
    for p, line in enumerate(lines):
        assert not line[point != p].any()
        assert abs(np.corrcoef(line[point == p], day[point == p])[0, 1]) == pytest.approx(1.0)
    mixed = pairs(day=rng.permutation(day), point=point)
    assert "along day by point" not in mixed  # names, as far as is known


def test_columns_on_different_axes_make_cells_too():
    rng = np.random.default_rng(6)
    given = {
        "channel": rng.integers(0, 5, (12, 30)),
        "weekend": np.arange(12) % 7 > 4,
        "noon": np.arange(30) % 6 == 3,
    }
    given |= {"morning": np.arange(30) < 9, "half": rng.uniform(size=(12, 30))}
    site = SimpleNamespace(axes=("day", "slot"), shape=(12, 30))
    problem = SimpleNamespace(
        data=given,
        observed=SimpleNamespace(arguments=frozenset()),
        declaration=SimpleNamespace(observed={"y": site}),
    )
    on_both = all_columns(problem, site)
    assert on_both.keys() == given.keys()
    np.testing.assert_array_equal(on_both["weekend"][:, 0], given["weekend"])
    np.testing.assert_array_equal(on_both["noon"][0], given["noon"])
    found = {made.name: made for made in cells(site.axes, site.shape, on_both)}
    assert found.keys() == {
        *("channel and weekend", "channel and noon", "channel and morning"),
        *("weekend and noon", "weekend and morning"),  # noon and morning both lie along slot alone
    }
    for name, of_cells in found.items():
        one, other = name.split(" and ")
        (by_cell,) = of_cells.curves()
        of_each = by_cell.values.toarray().reshape(-1, 12, 30)
        here, there = (np.broadcast_to(on_both[name], site.shape) for name in (one, other))
        assert len(of_each) == len({*zip(here.flat, there.flat, strict=True)})
        for cell in of_each > 0:
            assert len({*zip(here[cell], there[cell], strict=True)}) == 1
    within = {"channel": given["channel"], "low": given["channel"] < 2}
    assert not list(cells(site.axes, site.shape, within))


def test_a_band_may_differ_near_a_station_on_several_axes_too():
    rng = np.random.default_rng(7)
    band, distance = rng.integers(0, 3, (20, 24)), rng.uniform(30.0, 400.0, (20, 24))
    found = {
        f.label: (q, f)
        for q, f in together(("segment", "reading"), (20, 24), {"band": band, "distance": distance})
    }
    assert set(found) == {"along distance by band", "between two values of distance by band"}
    whole, some = found["between two values of distance by band"]
    assert whole.kept(("segment", "reading"), (20, 24)) == (0, 1)
    near = some.places.index(
        next(p for p in some.places if p.startswith(f"band 1, distance {distance.min():.4g} "))
    )
    inside = some.values[[near]].toarray().reshape(20, 24) > 0
    np.testing.assert_array_equal(inside, (band == 1) & (distance <= distance[inside].max()))


def test_columns_on_different_axes_are_looked_over_together_and_those_of_one_are_not_again():
    rng = np.random.default_rng(8)
    battery, heat, age = rng.uniform(size=(12, 1)), rng.uniform(size=(1, 30)), rng.uniform(size=(12, 1))
    given = {"battery": battery, "heat": heat, "age": age}
    found = {f.label: f for _, f in together(("node", "hour"), (12, 30), given)}
    assert {"over battery and heat", "over heat and age"} <= set(found)
    assert "over battery and age" not in found
    product = np.cos(np.pi * (np.argsort(np.argsort(battery[:, 0])) + 0.5) / 12)[:, None]
    product = product * np.cos(np.pi * (np.argsort(np.argsort(heat[0])) + 0.5) / 30)
    assert np.abs(np.corrcoef(product.reshape(-1), found["over battery and heat"].values[0])[0, 1]) > 0.999


def test_a_device_may_be_off_in_turns_while_it_sends():
    """What happens to a device's own packets in the first slots of every ten: others are none the wiser."""
    rng = np.random.default_rng(0)
    sending = rng.random((40, 30, 3)) < 0.3
    found = {
        curve.label: (over, curve)
        for over, curve in of_each("sending", ("episode", "slot", "device"), sending)
    }
    over, curve = found["every 10 along episode and slot of device 1 with sending 1"]
    assert over.axes == ("episode", "slot")
    assert over.kept(("episode", "slot", "outcome"), (40, 30, 4)) == (0, 1)
    turn = np.arange(1200) % 10
    expected = np.stack([(turn == phase) & sending[..., 1].reshape(-1) for phase in range(10)])
    assert np.array_equal(curve.values.toarray(), expected)
    _, stretch = found["stretch of slot by sending of each device"]
    at = stretch.places.index("device 1 with sending 1, slot 0 to 7")
    own = sending[..., 1] & (np.arange(30) < 8)
    assert np.array_equal(stretch.values[[at]].toarray().reshape(40, 30), own)


@pytest.mark.parametrize(
    "values", [np.zeros((9, 8, 3)), np.arange(216.0).reshape(9, 8, 3) % 3, np.eye(20)[:, :, None] > 0]
)
def test_only_what_is_often_a_yes_has_turns(values):
    assert not list(of_each("x", ("episode", "slot", "device"), values))
