"""Figures of reports: an interval plot, a plan view, a gap track.

Each function returns a `matplotlib.figure.Figure` of its own, drawn without pyplot and without touching
global settings. They are 5 inches wide, so that their letters stay legible on a telephone.
"""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from dtprob.report.palette import LIGHT, RAMP
from dtprob.report.units import decimals_for, number

WIDTH = 5.0
_LETTERS = 54
"""Of a row's name that have room in a line."""
STYLE: dict[Any, Any] = {
    "font.size": 11,
    "font.family": "DejaVu Sans",
    "text.color": LIGHT["ink"],
    "axes.edgecolor": LIGHT["muted"],
    "axes.labelcolor": LIGHT["ink"],
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.unicode_minus": True,
    "xtick.color": LIGHT["muted"],
    "ytick.color": LIGHT["muted"],
    "xtick.labelcolor": LIGHT["ink"],
    "ytick.labelcolor": LIGHT["ink"],
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "legend.frameon": False,
    "svg.fonttype": "none",
    "text.parse_math": False,  # names are the user's: a $ in them is a $
    "svg.hashsalt": "dtprob",
}


@dataclass(frozen=True)
class IntervalRow:
    """One row of an interval plot: its name, mean and interval, all of one unit."""

    name: str
    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class Classes:
    """The classes of a coloured quantity: colour i lies between edges i and i + 1, and the ends are open.

    The last edge may be infinite.
    """

    edges: Float[np.ndarray, " edge"]

    @property
    def colours(self) -> tuple[str, ...]:
        """One colour per class, from faint to strong."""
        picks = np.linspace(0, len(RAMP) - 1, len(self.edges) - 1).round().astype(int)
        return tuple(RAMP[int(pick)] for pick in picks)

    def __call__(self, value: ArrayLike) -> Int[np.ndarray, "..."]:
        """The class of each value."""
        return np.clip(
            np.searchsorted(self.edges, np.asarray(value), side="right") - 1, 0, len(self.colours) - 1
        )


def classes_for(*values: ArrayLike) -> Classes:
    """Up to six classes with round edges that cover all values but the most extreme two percent at either end.

    What lies far above them has the last class, which has no upper edge, for itself.
    """
    together = np.concatenate([np.ravel(np.asarray(value, dtype=float)) for value in values])
    low, high = min(0.0, float(np.quantile(together, 0.02))), float(np.quantile(together, 0.98))
    most = float(together.max())
    high = max(high if high > low else most, low + 1e-9)
    few = _edges(low, high, len(RAMP) - 2)
    beyond = 2 * few[-1] - few[-2]
    return Classes(np.append(few, [beyond, np.inf]) if most > beyond else _edges(low, high, len(RAMP)))


def _edges(low: float, high: float, count: int) -> Float[np.ndarray, " edge"]:
    """Round edges of at most so many classes."""
    edges = MaxNLocator(nbins=count, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    return np.asarray(edges[: count + 1], dtype=float)


def interval_plot(
    rows: Sequence[IntervalRow],
    *,
    label: str,
    null: float | None = None,
    bounds: tuple[float, float] | None = None,
) -> Figure:
    """A dot with its interval for each row, from top to bottom, below the row's name.

    Args:
        rows: what to show.
        label: name and unit of the axis.
        null: a value to mark with a line, for example the one that means "no effect".
        bounds: what the axis shows at least.
    """
    with mpl.rc_context(STYLE):
        figure, axes = _rows([row.name for row in rows], 0.55)
        if null is not None:
            for place in range(len(rows)):
                axes.plot([null, null], [place - 0.13, place + 0.13], color=LIGHT["muted"], linewidth=1)
        for place, row in enumerate(rows):
            axes.plot([row.low, row.high], [place, place], color=LIGHT["after"], linewidth=2.5)
            axes.plot(row.mean, place, "o", color=LIGHT["after"], markersize=7)
        if bounds is not None:
            axes.update_datalim([(bound, 0) for bound in bounds], updatey=False)
        axes.margins(x=0.03)
        axes.set_xlabel(label)
        return figure


def gap_track(before: float, after: float | None, floor: tuple[float, float] | None, *, unit: str) -> Figure:
    """The loss of the twin before and after the accepted effect, as bars from the lowest loss possible.

    Where the lowest loss is not known the losses are dots, since a bar would start nowhere.

    Args:
        before: held-out loss of the twin as it is.
        after: held-out loss with the accepted effect, or None where none was accepted.
        floor: bracket of the lowest loss that was found, or None where unknown.
        unit: unit of all of them.
    """
    rows = [("Twin as it is", before, LIGHT["before"])]
    if after is not None:
        rows.append(("With the cause added", after, LIGHT["after"]))
    names = [name for name, _, _ in rows] + ["Best possible"] * (floor is not None)
    shown = [*(value for _, value, _ in rows), *(floor or ())]
    decimals = decimals_for((max(shown) - min(shown)) / 10)
    with mpl.rc_context(STYLE):
        figure, axes = _rows(names, 0.55)
        for place, (_, value, colour) in enumerate(rows):
            if floor is None:
                axes.plot(value, place, "o", color=colour, markersize=8)
            else:
                axes.barh(place, value - floor[0], left=floor[0], height=0.26, color=colour)
            _beside(axes, value, place, number(value, decimals))
        if floor is not None:
            axes.plot(floor, [len(rows)] * 2, "|-", color=LIGHT["muted"], markersize=12, linewidth=1.3)
            _beside(axes, floor[1], len(rows), " to ".join(number(end, decimals) for end in floor))
        axes.margins(x=0.2)
        axes.set_xlabel(f"Loss on held-out data ({unit})")
        return figure


def plan_view(
    rx_position: Float[np.ndarray, "link 3"],
    tx_position: Float[np.ndarray, "link 3"],
    value: Float[np.ndarray, " link"],
    *,
    classes: Classes,
    label: str,
) -> Figure:
    """Receivers seen from above, coloured by a quantity of their link, and the transmitters.

    Args:
        rx_position: (link, 3) m.
        tx_position: (link, 3) m.
        value: (link,) the quantity.
        classes: its classes; share them between views that are to be compared.
        label: name and unit of the quantity.
    """
    receivers, transmitters = (
        np.asarray(rx_position, float),
        np.unique(np.asarray(tx_position, float), axis=0),
    )
    rank = classes(value)
    corners = np.concatenate([receivers, transmitters])[:, :2]
    extent = np.maximum(np.ptp(corners, axis=0), 1e-3)
    with mpl.rc_context(STYLE):
        figure, axes = plain_figure(float(np.clip(WIDTH * 0.86 * extent[1] / extent[0], 1.4, 4.4)) + 1.0)
        for index in range(len(classes.colours)):
            chosen = receivers[rank == index]
            size = 16 + 7 * index
            axes.scatter(
                chosen[:, 0],
                chosen[:, 1],
                s=size,
                color=classes.colours[index],
                edgecolor=LIGHT["muted"],
                linewidth=0.5,
            )
        axes.scatter(transmitters[:, 0], transmitters[:, 1], s=70, marker="^", color=LIGHT["ink"], zorder=3)
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.06)
        axes.set_xlabel("x (m)")
        axes.set_ylabel("y (m)")
        legend_bar(axes, classes, label)
        return figure


def plain_figure(height: float) -> tuple[Figure, Axes]:
    """An empty figure of a page's width, `height` inches high."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots()


def _beside(axes: Axes, x: float, y: float, text: str) -> None:
    axes.annotate(text, (x, y), (8, 0), textcoords="offset points", va="center")


def _rows(names: Sequence[str], height: float) -> tuple[Figure, Axes]:
    """Axes with a row for each name, whose name stands at the left above the row's place, in lines if it is long."""
    lines = [textwrap.wrap(name, _LETTERS) for name in names]
    height += 0.18 * (max(map(len, lines), default=1) - 1)
    figure, axes = plain_figure(0.65 + height * len(names))
    for place, parts in enumerate(lines):
        for above, text in enumerate(reversed(parts)):
            written = axes.annotate(
                text,
                (0, place),
                (0, 9.5 + 12.5 * above),
                ("axes fraction", "data"),
                "offset points",
                va="baseline",
                size=10.5,
            )
            written.set_in_layout(False)  # else the axes shrink until the name has room beside them
    axes.set_ylim(len(names) - 0.55, -0.75)
    axes.yaxis.set_visible(False)
    axes.spines["left"].set_visible(False)
    return figure, axes


def legend_bar(axes: Axes, classes: Classes, label: str) -> None:
    """The classes' colours in a row above the view, with their edges below them."""
    bar = axes.inset_axes((0.0, 1.1, 1.0, 0.045))
    count = len(classes.colours)
    for index, colour in enumerate(classes.colours):
        bar.axvspan(index, index + 1, facecolor=colour, edgecolor=LIGHT["muted"], linewidth=0.5)
    bar.set_xlim(0, count)
    bar.set_yticks([])
    edges = [f"{edge:.4g}" if np.isfinite(edge) else "" for edge in classes.edges]
    bar.set_xticks(range(count + 1), edges, size=10)
    bar.tick_params(axis="x", length=0, pad=2)
    for spine in bar.spines.values():
        spine.set_visible(False)
    bar.set_title(label, size=11, loc="left", pad=4)
