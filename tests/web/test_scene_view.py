"""The traced scene on the page: lines lead from transmitter to receiver, shares are of the twin's own excess."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from dtprob.report import render
from dtprob.report.charts import scene_charts
from dtprob.report.scene_view import scene


@pytest.fixture
def paths() -> xr.Dataset:
    """Two links with a direct path, one by way of a wall, and a missing one."""
    link, path = ("link", "path"), ("link", "path", "step")
    interaction = np.zeros((2, 3, 1), int)
    interaction[:, 1] = 1
    vertex = np.zeros((2, 3, 1, 3))
    vertex[:, 1, 0] = [[5.0, 4.0, 1.0], [7.0, 4.0, 1.0]]
    return xr.Dataset(
        {
            "before": (link, np.array([[1.0, 8.0, 99.0], [-0.5, 6.0, 99.0]])),
            "after": (link, np.array([[0.5, 1.0, 99.0], [-0.5, -0.2, 99.0]])),
            "mask": (link, np.array([[True, True, False]] * 2)),
            "interaction": (path, interaction),
            "object": (path, np.where(interaction > 0, 1, 0)),
            "vertex": ((*path, "direction"), vertex),
            "rx_position": (("link", "direction"), np.array([[10.0, 0.0, 1.5], [14.0, 0.0, 1.5]])),
            "tx_position": (("link", "direction"), np.zeros((2, 3))),
            "object_name": (("object_index",), np.array(["floor", "wall_2"])),
        }
    )


def test_lines_and_shares(paths: xr.Dataset) -> None:
    before, after = scene(paths, "before"), scene(paths, "after")
    assert len(before.lines) == 4
    np.testing.assert_array_equal(before.lines[1], [[0.0, 0.0], [5.0, 4.0], [10.0, 0.0]])
    np.testing.assert_array_equal(before.lines[2], [[0.0, 0.0], [14.0, 0.0]])
    np.testing.assert_array_equal(before.excess, [1.0, 8.0, -0.5, 6.0])
    assert [(name, share) for name, _, _, share in before.objects] == [("wall_2", pytest.approx(14 / 15))]
    assert after.objects[0][3] == pytest.approx(1 / 15)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_path_without_a_number_is_left_out(paths: xr.Dataset, value: float) -> None:
    """It cost the whole report."""
    paths["before"][0, 0] = value
    report: Any = {"gap": {"after": 0.5}}
    before, after = scene_charts(report, xr.DataTree.from_dict({"paths": paths}))
    assert all("3 paths; share of the excess on paths by way of wall 2" in one.svg for one in (before, after))
    assert "by way of wall 2 100%" in before.svg


def test_paths_that_meet_nothing_are_told_without_objects(paths: xr.Dataset) -> None:
    report: Any = {"gap": {"after": None}}
    (chart,) = scene_charts(report, xr.DataTree.from_dict({"paths": paths.isel(path=[0])}))
    assert "Scene from above, the twin as it is: 2 paths." in chart.svg


def test_the_page_draws_the_scene(paths: xr.Dataset, examples: dict[str, Any], gap: xr.DataTree) -> None:
    gap["paths"] = xr.DataTree(paths)
    listed = render(examples["LISTED"](), gap, title="x")
    assert listed.count('aria-label="Scene from above') == 2
    assert "by way of wall 2 93%" in listed
    assert render(examples["UNLISTED"](), gap, title="x").count('aria-label="Scene from above') == 1
    assert "Scene from above" not in render(examples["NO_GAP"](), gap, title="x")
