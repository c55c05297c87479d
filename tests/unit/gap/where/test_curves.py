"""Ways to vary over what a model computes: by value where it takes few values, as entries of a table are."""

import numpy as np
import pytest
from scipy import sparse

from dtprob.gap.where.curves import groups, quantity


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
