"""What captions say of a map: whether a place stands out, and what was not observed."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from dtprob.report.charts import coordinate_charts


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


def test_what_was_not_observed_is_said() -> None:
    assert "2 not shown: nothing was observed there." in caption("NO_GAP", [0.0, np.nan, 1.0, np.nan])
    assert "not shown" not in caption("NO_GAP", [0.0, 1.0])
