"""The traced scene from above: paths and the objects that they meet, by what they carry of the gap."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from dtprob.report.figures import STYLE, WIDTH, Classes, legend_bar
from dtprob.report.palette import LIGHT

_STRONGEST = 60
"""Paths that are coloured; the others are grey."""
_OTHERS = 240
_NAMED = 4
"""Objects that are named at most."""
_LEAST = 0.1
"""Share from which on an object is named."""


@dataclass(frozen=True)
class Scene:
    """Paths as lines, with what each carries.

    Attributes:
        lines: corners (corner, 2) of each path, from transmitter to receiver, in m.
        excess: nats of each path, above chance.
        objects: name, centre (2,), points (point, 2) and share of the excess on paths by way of each object, falling.
    """

    lines: tuple[np.ndarray, ...]
    excess: np.ndarray
    objects: tuple[tuple[str, np.ndarray, np.ndarray, float], ...]


def scene(paths: xr.Dataset, when: str) -> Scene:
    """The scene of the group `paths` of gap.nc; shares are of what all paths carry before the cause is added.

    Paths whose excess is not finite are left out.

    Args:
        paths: the group.
        when: "before" or "after" the cause.
    """
    excess = paths[when].values
    exists = paths["mask"].values & np.isfinite(excess) & np.isfinite(paths["before"].values)
    kept = np.argwhere(exists)
    steps, vertex, owner = (paths[name].values for name in ("interaction", "vertex", "object"))
    start, end = paths["tx_position"].values, paths["rx_position"].values
    lines = [
        np.concatenate(
            [start[link, None, :2], vertex[link, path, steps[link, path] > 0, :2], end[link, None, :2]]
        )
        for link, path in kept
    ]
    carried = np.where(exists, np.maximum(excess, 0.0), 0.0)
    total = max(float(np.maximum(paths["before"].values[exists], 0.0).sum()), 1e-300)
    met = (steps > 0) & exists[..., None]
    found = []
    for index, name in enumerate(paths["object_name"].values):
        on = met & (owner == index)
        if on.any():
            points = vertex[on][:, :2]
            found.append(
                (str(name), points.mean(axis=0), points, float(carried[on.any(axis=-1)].sum()) / total)
            )
    found.sort(key=lambda one: -one[3])
    return Scene(tuple(lines), excess[tuple(kept.T)], tuple(found))


def scene_view(shown: Scene, transmitters: np.ndarray, receivers: np.ndarray, *, classes: Classes) -> Figure:
    """The scene from above, its strongest paths coloured by what they carry, the objects with the largest shares named.

    Args:
        shown: the scene.
        transmitters: positions (n, 2) in m.
        receivers: likewise.
        classes: of what a path carries; share them between views that are to be compared.
    """
    order = np.argsort(-shown.excess)
    corners = np.concatenate([transmitters, receivers, *(points for _, _, points, _ in shown.objects)])
    extent = np.maximum(np.ptp(corners, axis=0), 1e-3)
    with mpl.rc_context(STYLE):
        height = float(np.clip(WIDTH * 0.86 * extent[1] / extent[0], 1.4, 4.4)) + 1.0
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        axes = figure.subplots()
        rest = [shown.lines[i] for i in order[_STRONGEST : _STRONGEST + _OTHERS]]
        axes.add_collection(LineCollection(rest, colors=LIGHT["muted"], linewidths=0.3, alpha=0.35))
        rank = classes(shown.excess)
        strongest = order[:_STRONGEST][::-1]
        colours = [classes.colours[int(rank[i])] for i in strongest]
        widths = [0.5 + 0.25 * int(rank[i]) for i in strongest]
        axes.add_collection(
            LineCollection([shown.lines[i] for i in strongest], colors=colours, linewidths=widths)
        )
        _objects(axes, shown)
        axes.scatter(receivers[:, 0], receivers[:, 1], s=12, color=LIGHT["ink"], zorder=3)
        axes.scatter(transmitters[:, 0], transmitters[:, 1], s=70, marker="^", color=LIGHT["ink"], zorder=3)
        axes.update_datalim(corners)
        axes.autoscale_view()
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.06)
        axes.set_xlabel("x (m)")
        axes.set_ylabel("y (m)")
        legend_bar(axes, classes, "Excess of each path (nats)")
        return figure


def _objects(axes: Axes, shown: Scene) -> None:
    for _, _, points, _ in shown.objects:
        axes.scatter(points[:, 0], points[:, 1], s=5, marker="s", color=LIGHT["muted"], linewidth=0, zorder=2)
    for name, centre, _, share in (one for one in shown.objects[:_NAMED] if one[3] >= _LEAST):
        text = f"{name.replace('_', ' ')} {100 * share:.0f}%"
        box = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.0}
        axes.annotate(text, tuple(centre), ha="center", va="center", size=9.5, zorder=4, bbox=box)
