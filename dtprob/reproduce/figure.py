"""What a reproduced figure is, as data: one or more panels of series, with bands over runs."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float

from dtprob.files import atomic_write, write_text


@final
@dataclass(frozen=True)
class Quantity:
    """What an axis shows.

    Attributes:
        name: in words.
        unit: "1" where there is none.
        is_log: draw the axis logarithmically.
    """

    name: str
    unit: str = "1"
    is_log: bool = False

    @property
    def label(self) -> str:
        """Name and unit."""
        return self.name if self.unit == "1" else f"{self.name} ({self.unit})"


@final
@dataclass(frozen=True)
class Series:
    """A curve with a band.

    Attributes:
        name: as in legends and files.
        x: where.
        median: the middle of the runs.
        low, high: edges of the band; equal to the median where there is none.
    """

    name: str
    x: Float[np.ndarray, " point"]
    median: Float[np.ndarray, " point"]
    low: Float[np.ndarray, " point"]
    high: Float[np.ndarray, " point"]

    @classmethod
    def of_runs(
        cls,
        name: str,
        x: Sequence[float] | Float[np.ndarray, " point"],
        values: Float[np.ndarray, "run point"],
        quantiles: tuple[float, float] = (0.25, 0.75),
    ) -> "Series":
        """Median and quantiles over runs."""
        low, median, high = np.quantile(values, [quantiles[0], 0.5, quantiles[1]], axis=0)
        return cls(name, np.asarray(x, float), median, low, high)


@final
@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Attributes:
        title: what is shown.
        x, y: its axes.
        series: its curves.
    """

    title: str
    x: Quantity
    y: Quantity
    series: tuple[Series, ...]


@final
@dataclass(frozen=True)
class Figure:
    """A reproduced figure.

    Attributes:
        figure: its name on the command line.
        title: what it shows.
        panels: at least one.
        runs: how many runs the bands are over.
        notes: facts of the run in words or numbers, such as choices made where the source is silent.
    """

    figure: str
    title: str
    panels: tuple[Panel, ...]
    runs: int
    notes: tuple[str, ...] = ()

    def to_dict(self, *, seed: int, command: str, seconds: float) -> dict[str, Any]:
        """The content of FIGURE.json; a single panel's axes and series stand at the top."""
        head = {"figure": self.figure, "title": self.title}
        panels = [_panel(panel) for panel in self.panels]
        body = (
            {k: v for k, v in panels[0].items() if k != "title"} if len(panels) == 1 else {"panels": panels}
        )
        tail = {"runs": self.runs, "seed": seed, "command": command, "seconds": round(seconds, 1)}
        return {**head, **body, **tail, **({"notes": list(self.notes)} if self.notes else {})}


def write(figure: Figure, out: Path, *, seed: int, command: str, seconds: float) -> tuple[Path, Path]:
    """Write FIGURE.json and FIGURE.png into a folder.

    Args:
        figure: what to write.
        out: the folder.
        seed: of the run.
        command: that made it.
        seconds: that it took.
    """
    files = out / f"{figure.figure}.json", out / f"{figure.figure}.png"
    content = figure.to_dict(seed=seed, command=command, seconds=seconds)
    write_text(files[0], json.dumps(content, indent=1, allow_nan=False) + "\n")
    with atomic_write(files[1]) as path:
        draw(figure).savefig(path, dpi=150, facecolor="white")
    return files


def draw(figure: Figure) -> Any:
    """The figure as a `matplotlib.figure.Figure` of its own, without pyplot."""
    import matplotlib as mpl  # noqa: PLC0415  (slow to import)
    from matplotlib.figure import Figure as Canvas  # noqa: PLC0415

    columns = min(len(figure.panels), 2)
    rows = math.ceil(len(figure.panels) / columns)
    with mpl.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "legend.frameon": False}):
        canvas = Canvas(figsize=(5.2 * columns, 3.8 * rows), layout="constrained")
        axes = canvas.subplots(rows, columns, squeeze=False).ravel()
        for place, panel in zip(axes, figure.panels, strict=False):
            _draw(place, panel)
        for place in axes[len(figure.panels) :]:
            place.remove()
        canvas.suptitle(figure.title)
    return canvas


def _draw(place: Any, panel: Panel) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter  # noqa: PLC0415  (slow to import)

    markers = "osD^vP*X"
    for number, series in enumerate(panel.series):
        (line,) = place.plot(
            series.x, series.median, marker=markers[number % len(markers)], ms=4, lw=1.2, label=series.name
        )
        if np.any(series.low != series.high):
            place.fill_between(series.x, series.low, series.high, alpha=0.15, color=line.get_color(), lw=0)
    place.set(title=panel.title, xlabel=panel.x.label, ylabel=panel.y.label)
    for axis, quantity, scale in (
        (place.xaxis, panel.x, place.set_xscale),
        (place.yaxis, panel.y, place.set_yscale),
    ):
        if quantity.is_log:
            scale("log")
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
    place.legend(fontsize=7, ncols=2 if len(panel.series) > 6 else 1)


def _panel(panel: Panel) -> dict[str, Any]:
    return {
        "title": panel.title,
        "x": {"name": panel.x.name, "unit": panel.x.unit},
        "y": {"name": panel.y.name, "unit": panel.y.unit},
        "series": [_series(series) for series in panel.series],
    }


def _series(series: Series) -> dict[str, Any]:
    arrays = {name: getattr(series, name) for name in ("x", "median", "low", "high")}
    return {"name": series.name, **{name: _numbers(array) for name, array in arrays.items()}}


def _numbers(array: Float[np.ndarray, " point"]) -> list[float | None]:
    """Six digits; null where there is no finite number."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in np.asarray(array, float)]
