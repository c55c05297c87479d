"""Figures of reports over one coordinate of the data: a misfit, and what a cause closes of it."""

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike
from scipy.stats import norm

from dtprob.report.figures import STYLE, plain_figure
from dtprob.report.palette import LIGHT


def usual_limit(count: int) -> float:
    """Within which all of so many independent normal values stay in 95 of 100 cases."""
    return float(norm.ppf(1 - 0.025 / max(count, 1)))


def coordinate_map(
    coordinate: ArrayLike,
    before: ArrayLike,
    after: ArrayLike | None = None,
    *,
    label: str,
    threshold: float | Float[np.ndarray, " coordinate"],
    amount: str = "Excess (std. dev.)",
) -> Figure:
    """A misfit over one coordinate of the data, before and after the accepted effect.

    Args:
        coordinate: (coordinate,) numbers, or names.
        before: (coordinate,) misfit of the twin as it is.
        after: (coordinate,) the same with the accepted effect.
        label: name and unit of the coordinate.
        threshold: all values stay within +-threshold in 95 of 100 data sets when the twin is right; see `usual_limit`.
        amount: what is drawn, with its unit.
    """
    names = np.asarray(coordinate)
    place = names if np.issubdtype(names.dtype, np.number) else np.arange(names.size)
    with mpl.rc_context(STYLE):
        figure, axes = plain_figure(2.7)
        if isinstance(threshold, np.ndarray):
            axes.fill_between(place, -threshold, threshold, color=LIGHT["floor"], linewidth=0)
        else:
            axes.axhspan(-threshold, threshold, color=LIGHT["floor"], linewidth=0)
        marker = names.size <= 48
        for value, name, shape in ((before, "before", "s"), (after, "after", "o")):
            if value is not None:
                values = np.asarray(value, dtype=float)
                style = shape if marker else ""
                axes.plot(
                    place, values, f"{style}-", color=LIGHT[name], markersize=4.5, linewidth=1.3, label=name
                )
        _name_places(axes, names, place)
        axes.yaxis.set_major_locator(MaxNLocator(5))
        limit = float(np.max(threshold))
        if max(np.max(np.abs(np.asarray(before))), limit) > 40 * limit:
            axes.set_yscale("symlog", linthresh=limit)
        if after is not None:
            _legend_above(axes)
        axes.set_xlabel(label)
        axes.set_ylabel(amount)
        return figure


def share_map(
    coordinate: Float[np.ndarray, " coordinate"],
    found: Float[np.ndarray, " coordinate"],
    expected: Float[np.ndarray, " coordinate"],
    reach: Float[np.ndarray, " coordinate"],
    *,
    label: str,
) -> Figure:
    """Shares of what a cause closes over one coordinate, beside those that it should close.

    Args:
        coordinate: places.
        found: shares in percent.
        expected: shares in percent that the cause closes on average.
        reach: all of `found` stay so near to `expected` in 95 of 100 data sets if the cause is right.
        label: name and unit of the coordinate.
    """
    with mpl.rc_context(STYLE):
        figure, axes = plain_figure(2.7)
        axes.fill_between(coordinate, expected - reach, expected + reach, color=LIGHT["floor"], linewidth=0)
        axes.plot(coordinate, expected, "-", color=LIGHT["muted"], linewidth=1.3, label="should close")
        axes.plot(coordinate, found, "o", color=LIGHT["after"], markersize=4.5, label="closes")
        _name_places(axes, coordinate, coordinate)
        axes.yaxis.set_major_locator(MaxNLocator(5))
        _legend_above(axes)
        axes.set_xlabel(label)
        axes.set_ylabel("Of what is closed (%)")
        return figure


def _name_places(axes: Axes, names: np.ndarray, place: np.ndarray) -> None:
    if place is not names:
        axes.set_xticks(place, [str(name) for name in names], rotation=0 if names.size <= 6 else 45)
    elif names.size <= 10:
        axes.set_xticks(place)


def _legend_above(axes: Axes) -> None:
    axes.legend(loc="lower left", bbox_to_anchor=(-0.02, 0.97), ncols=2, labelcolor="linecolor", borderpad=0)
