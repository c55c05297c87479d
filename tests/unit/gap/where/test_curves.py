"""Ways to vary over what a model computes: by value where it takes few values, as entries of a table are."""

import numpy as np
import pytest
from scipy import sparse

from dtprob.gap.where.curves import quantity


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
