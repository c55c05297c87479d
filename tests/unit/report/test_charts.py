"""What captions say of a map: whether a place stands out, and what was not observed."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from dtprob.gap.diagnosis import Diagnosis
from dtprob.report.axis_charts import closed_charts, coordinate_charts, difference_charts
from dtprob.report.charts import plan_charts


def caption(verdict: str, excess: list[float], *, named: bool = False) -> str:
    """Of the only map of a report."""
    blocks = [{"axes": {"link": [1, 1]}, "p_value": 0.001, "share": 1.0}] if named else []
    report: Any = {"verdict": verdict, "where": {"coordinates": blocks}, "gap": {"after": None}}
    gap = xr.DataTree.from_dict({"where": xr.Dataset({"gap_link": ("link", np.array(excess))})})
    (chart,) = coordinate_charts(report, gap)
    return chart.caption


@pytest.mark.parametrize("named", [False, True])
def test_a_gap_without_a_place_is_a_pattern(named: bool) -> None:
    assert ("a pattern across them" in caption("UNLISTED", [0.0, 1.0, -1.0], named=named)) is not named
    assert "a pattern" not in caption("UNLISTED", [0.0, 9.0, -1.0], named=named)


def test_a_value_outside_is_chance_where_nothing_is_found() -> None:
    assert "outside by chance" in caption("NO_GAP", [0.0, 9.0, -1.0])
    assert "outside by chance" not in caption("NO_GAP", [0.0, 1.0, -1.0])
    assert "outside by chance" not in caption("LISTED", [0.0, 9.0, -1.0])


@pytest.mark.parametrize("axis", ["hours_after_rain", "after_rain"])
@pytest.mark.parametrize("after", [None, 0.5])
def test_an_axis_may_be_called_after_something(axis: str, after: float | None) -> None:
    report: Any = {"verdict": "LISTED", "where": {"coordinates": []}, "gap": {"after": after}}
    values = {f"{name}_{axis}": (axis, np.array([0.0, 9.0])) for name in ("gap", "gap_after")}
    (chart,) = coordinate_charts(report, xr.DataTree.from_dict({"where": xr.Dataset(values)}))
    assert ("; after, the highest excess" in chart.svg) is (after is not None)


def test_what_was_not_observed_is_said() -> None:
    assert "2 not shown: nothing was observed there." in caption("NO_GAP", [0.0, np.nan, 1.0, np.nan])
    assert "not shown" not in caption("NO_GAP", [0.0, 1.0])


def test_a_slash_in_an_axis_costs_no_map() -> None:
    """The diagnosis was lost when its maps were to be written."""
    maps = {"where": xr.Dataset({"gap_site/floor": ("site/floor", np.array([0.0, 9.0]))})}
    gap = Diagnosis("UNLISTED", "", (), {}, maps).to_datatree()
    blocks = [{"axes": {"site/floor": [1, 1]}, "p_value": 0.001, "share": 1.0}]
    report: Any = {"verdict": "UNLISTED", "where": {"coordinates": blocks}, "gap": {"after": None}}
    (chart,) = coordinate_charts(report, gap)
    assert "highest excess is 9.00" in chart.svg


def closed(found: list[float], expected: list[float], nats: float) -> str:
    """What the only map of shares says."""
    report: Any = {"causes": [{}], "gap": {"after": 0.0}}
    shares = {
        "closed_link": ("link", np.array(found), {"nats": nats}),
        "closed_expected_link": ("link", np.array(expected)),
    }
    (chart,) = closed_charts(report, xr.DataTree.from_dict({"where": xr.Dataset(shares)}))
    return chart.caption


def test_a_cause_that_closes_the_gap_elsewhere_than_it_should_is_told() -> None:
    assert "something else" not in closed([0.75, 0.15, 0.1], [0.7, 0.2, 0.1], 50.0)
    assert "something else" in closed([0.1, 0.15, 0.75], [0.7, 0.2, 0.1], 50.0)
    assert "something else" not in closed([0.1, 0.15, 0.75], [0.7, 0.2, 0.1], 2.0)


def test_long_axes_are_drawn_in_groups() -> None:
    """A thousand positions that each stray as chance allows, and far more than their own share."""
    rng = np.random.default_rng(0)
    expected = np.full(1000, 1e-3)
    found = expected + np.sqrt(2 * expected / 100) * rng.normal(size=1000)
    assert "something else" not in closed(list(found / found.sum()), list(expected), 100.0)


def test_no_map_of_shares_without_a_cause() -> None:
    report: Any = {"causes": [], "gap": {"after": None}}
    assert closed_charts(report, None) == []


def test_places_keep_their_numbers_where_others_are_not_shown() -> None:
    report: Any = {"verdict": "UNLISTED", "where": {"coordinates": []}, "gap": {"after": None}}
    excess = np.array([np.nan, 0.0, np.nan, 9.0, 0.1])
    gap = xr.DataTree.from_dict({"where": xr.Dataset({"gap_link": ("link", excess)})})
    (chart,) = coordinate_charts(report, gap)
    assert "9.00 standard deviations at 3" in chart.svg


def test_the_map_of_links_has_the_unit_of_its_numbers() -> None:
    """gap.nc holds the loss of each link over its number of observations."""
    report: Any = {"gap": {"after": None}}
    ends = {f"{end}_position": (("link", "direction"), np.arange(6.0).reshape(2, 3)) for end in ("rx", "tx")}
    gap = xr.DataTree.from_dict({"links": xr.Dataset({"before": ("link", np.array([0.0, 0.5])), **ends})})
    (chart,) = plan_charts(report, gap)
    assert "Excess of each link (nats per observation)" in chart.svg
    assert "median excess 0.250 nats per observation, worst 0.500 at x 3.0 m, y 4.0 m" in chart.svg


def test_nothing_is_drawn_where_there_are_no_numbers() -> None:
    """What was nowhere observed, and what could not be told after a cause."""
    report: Any = {"verdict": "FOUND", "where": {"coordinates": []}, "gap": {"after": 1.0}, "causes": [1]}
    nothing, some = np.full(2, np.nan), np.array([0.5, 1.0])
    ends = {f"{end}_position": (("link", "direction"), np.arange(6.0).reshape(2, 3)) for end in ("rx", "tx")}
    told = {"column": "x", "observed": "y", "unit": "", "of": 2}
    place = {"place_0": ("place", some, told), "before_0": ("place", nothing), "spread_0": ("place", nothing)}
    where = {
        "gap_link": ("link", some),
        "gap_after_link": ("link", nothing),
        "closed_link": ("link", nothing, {"nats": 1.0}),
        "closed_expected_link": ("link", nothing),
    }
    groups = {"links": {"before": ("link", nothing), **ends}, "differences": place, "where": where}
    gap = xr.DataTree.from_dict({name: xr.Dataset(value) for name, value in groups.items()})
    assert plan_charts(report, gap) == []
    assert difference_charts(report, gap) == []
    assert closed_charts(report, gap) == []
    (chart,) = coordinate_charts(report, gap)
    assert "before, the highest excess" in chart.svg
    assert "after" not in chart.svg
