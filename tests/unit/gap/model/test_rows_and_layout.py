"""Where rows and coordinates lie: clusters of unequal size, padding, columns as clusters, local blocks."""

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dtprob.errors import InputError
from dtprob.gap.model.layout import make_layout, normal_of
from dtprob.gap.model.own import Own
from dtprob.gap.model.rows import make_rows
from dtprob.models.declaration import declare


def grid_model(y=None, count=None):
    with numpyro.plate("link", 3, dim=-2):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0))
        with numpyro.plate("sample", 4, dim=-1):
            numpyro.sample("y", dist.Normal(level, 1.0), obs=y)
        numpyro.sample("count", dist.Poisson(jnp.ones((3, 1))), obs=count)


def flat_model(y=None, device=None):
    with numpyro.plate("row", 7):
        numpyro.sample("y", dist.Normal(0.0, 1.0), obs=y)


GRID = {"y": np.zeros((3, 4)), "count": np.ones((3, 1), int)}
SHAPES = {"y": (2, 3, 4), "count": (1, 3, 1)}


def test_rows_of_all_sites_gather_by_cluster():
    rows = make_rows(declare(grid_model, GRID), SHAPES, {"y": 1, "count": 1}, GRID, None)
    values = {"y": jnp.arange(24.0).reshape(2, 3, 4), "count": 100.0 + jnp.arange(3.0).reshape(1, 3, 1)}
    stacked = np.asarray(rows.stack(values))
    assert rows.cluster_name == "link"
    assert rows.n_cluster == 3
    for link in range(3):
        own = np.concatenate([np.asarray(values["y"])[:, link].ravel(), [100.0 + link]])
        assert sorted(stacked[link]) == sorted(own)


def test_coordinates_name_each_row():
    rows = make_rows(declare(grid_model, GRID), SHAPES, {"y": 1, "count": 1}, GRID, None)
    y, n = np.indices((2, 3, 4)), 24
    np.testing.assert_array_equal(rows.coordinates["link"][:n], y[1].ravel())
    np.testing.assert_array_equal(rows.coordinates["sample"][:n], y[2].ravel())
    np.testing.assert_array_equal(rows.coordinates["link"][n:], [0, 1, 2])
    np.testing.assert_array_equal(rows.located[:n], (y[0] == 0).ravel())


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(-3, 3), min_size=7, max_size=7))
@example([2, 0, 3, -1, 1, -3, -2])
def test_a_column_makes_ragged_clusters(labels):
    data = {"y": np.zeros(7), "device": np.array(labels)}
    rows = make_rows(declare(flat_model, data), {"y": (2, 7)}, {"y": 1}, data, "device")
    value = jnp.arange(1.0, 15.0).reshape(2, 7)
    stacked = np.asarray(rows.stack({"y": value}))
    names = labels if len(set(labels)) == len(labels) else np.unique(labels)
    assert rows.n_cluster == len(names)
    for c, name in enumerate(names):
        own = np.asarray(value)[:, np.array(labels) == name].ravel()
        assert sorted(stacked[c][stacked[c] > 0]) == sorted(own)
    assert stacked.sum() == value.sum()  # every row once, padding is zero
    padded = rows.by_cluster(rows.located) < 0
    assert np.all(stacked[padded] == 0)


def test_text_may_name_clusters():
    data = {"y": np.zeros(7), "device": np.array(list("bbacaab"))}
    rows = make_rows(declare(flat_model, {"y": np.zeros(7)}), {"y": (1, 7)}, {"y": 1}, data, "device")
    np.testing.assert_array_equal(rows.ids, [1, 1, 0, 2, 0, 0, 1])


def test_an_unknown_cluster_axis_is_refused():
    with pytest.raises(InputError, match="cluster"):
        make_rows(declare(grid_model, GRID, cluster="room"), SHAPES, {"y": 1, "count": 1}, GRID, None)


def test_local_blocks_have_one_row_per_cluster():
    layout = make_layout(
        [
            ("scale", None, ()),
            ("level", None, (3, 2)),
            ("turn", None, (2, 3)),
            ("mixed", None, (3,)),
            ("bias", "offset", (2,)),
        ],
        {"level": Own(0, np.arange(3)), "turn": Own(1, np.arange(3)), "mixed": Own(0, np.array([2, 0, 1]))},
    )
    assert layout.dimension == 18
    assert [b.local for b in layout.blocks] == [False, True, True, True, False]
    np.testing.assert_array_equal(layout["level"].index, [[1, 2], [3, 4], [5, 6]])
    np.testing.assert_array_equal(layout["turn"].index, [[7, 10], [8, 11], [9, 12]])
    np.testing.assert_array_equal(layout["mixed"].index, [[15], [13], [14]])
    np.testing.assert_array_equal(layout["bias"].index, [[16, 17]])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.lists(st.integers(1, 3), max_size=3), min_size=1, max_size=4))
def test_parts_come_back_as_they_were_put(shapes):
    entries = [(f"s{i}", None, tuple(s)) for i, s in enumerate(shapes)]
    layout, x = make_layout(entries, {}), np.zeros(sum(int(np.prod(s)) for s in shapes))
    values = {e[0]: np.random.default_rng(i).normal(size=e[2]) for i, e in enumerate(entries)}
    for name, value in values.items():
        layout.put(x, name, value)
    for name, value in values.items():
        np.testing.assert_array_equal(layout.part(x, name), value)


def test_shared_blocks_move_between_layouts():
    own = {"b": Own(0, np.arange(3))}
    old = make_layout([("a", None, (2,)), ("b", None, (3,))], own)
    new = make_layout([("b", None, (3,)), ("new", "e", ()), ("a", None, (2,))], own)
    x = np.full(6, -1.0)
    new.copy_into(x, old, np.arange(5.0))
    np.testing.assert_array_equal(x, [2, 3, 4, -1, 0, 1])


def test_sites_of_earlier_data_that_go_together_are_one():
    """An intercept and a slope that are known only together: apart, each would be free to take up a change."""
    rng = np.random.default_rng(0)
    slope = rng.standard_normal((1000, 1))
    draws = {
        "level": 5 * slope + 0.1 * rng.standard_normal((1000, 1)),
        "noise": rng.standard_normal((1000, 2)),
        "slope": slope,
    }
    known = normal_of(draws)
    assert list(known) == [("level", "slope"), ("noise",)]
    mean, precision = known["level", "slope"]
    share = (1000 - 2 - 2) / (1000 - 1)  # an inverse covariance of draws is too large by the inverse
    expected = np.cov(np.hstack([draws["level"], slope]).T) / share
    np.testing.assert_allclose(np.linalg.inv(precision), expected, rtol=1e-6)
    np.testing.assert_allclose(mean, [draws["level"].mean(), slope.mean()])


@pytest.mark.parametrize("size", [100, 300, 450])
def test_what_many_sites_of_earlier_data_are_known_to_is_told_without_bias(size):
    """The plain inverse says that each is known 1.1, 1.4 and 1.8 times as well as it is."""
    rng = np.random.default_rng(0)
    draws = rng.standard_normal((1000, size))
    ((_, precision),) = normal_of({"level": draws}).values()
    assert np.diag(precision).mean() == pytest.approx(1.0, abs=0.02)
    ((_, again),) = normal_of({"level": np.tile(draws, (3, 1))}).values()  # drawn with replacement
    np.testing.assert_allclose(again, precision, rtol=1e-2)


def test_draws_that_come_again_weigh_more():
    """A sampler on a grid, or one that resamples: what is drawn often is likely."""
    weighed = np.random.default_rng(0).choice(
        [-1.0, 0.0, 1.0, 2.0, 3.0, 4.0], (1000, 1), p=[0.05, 0.8, 0.05, 0.04, 0.03, 0.03]
    )
    ((mean, precision),) = normal_of({"level": weighed}).values()
    assert mean[0] == pytest.approx(weighed.mean())
    share = (6 - 1 - 2) / (6 - 1)
    assert 1 / precision[0, 0] == pytest.approx(weighed.var(ddof=1) / share)


def test_too_few_draws_for_many_sites_are_refused():
    with pytest.raises(InputError, match=r"2400 different draws or more, for 1200 unknowns .* got 1000"):
        normal_of({"level": np.random.default_rng(0).standard_normal((1000, 1200))})


def test_a_point_is_known_exactly():
    ((mean, precision),) = normal_of({"level": np.full((1000, 2), 3.0)}).values()
    np.testing.assert_array_equal(mean, [3.0, 3.0])
    assert np.all(np.diag(precision) > 1e8)
