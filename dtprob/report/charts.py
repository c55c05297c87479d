"""The figures of one report's page, each with a caption and a description for those who cannot see it."""

from collections.abc import Iterator

import numpy as np
import xarray as xr

from dtprob.report.axis_charts import closed_charts, coordinate_charts, difference_charts
from dtprob.report.chart import Chart, group
from dtprob.report.figures import IntervalRow, classes_for, gap_track, interval_plot, plan_view
from dtprob.report.json_schema import Interval, Report, is_quiet
from dtprob.report.names import capital, listing, together, words
from dtprob.report.scene_view import Scene, scene, scene_view
from dtprob.report.svg import inline_svg
from dtprob.report.units import number


def gap_chart(report: Report) -> Chart | None:
    """The loss before and after, against the lowest possible; None where the loss is not determined."""
    gap = report["gap"]
    if gap["before"] is None:
        return None
    lowest, highest = gap["floor"] or (None, None)
    floor = None if lowest is None or highest is None else (lowest, highest)
    told = [f"Loss of the twin as it is: {number(gap['before'])} {gap['unit']}."]
    if gap["after"] is not None:
        told.append(f"With the cause: {number(gap['after'])}.")
    if floor is not None:
        told.append(f"Best possible: between {number(floor[0])} and {number(floor[1])}.")
    figure = gap_track(gap["before"], gap["after"], floor, unit=gap["unit"])
    caption = (
        "Shorter bars are better; the best that was found lies somewhere on the lowest line. With a loss "
        "of 0.1 nats per observation more, a twin finds what was measured about 10% less likely at each observation."
    )
    return Chart(
        inline_svg(figure, " ".join(told)), caption if floor is not None else "Further left is better."
    )


def closing_chart(report: Report) -> Chart | None:
    """The closed fraction of each cause, where there are several to compare, but not too many."""
    rows = [
        IntervalRow(capital(together(cause["effects"])), *shares)
        for cause in report["causes"]
        if (shares := _in_percent(cause["closed_fraction"])) is not None
    ]
    if not 2 <= len(rows) <= 12:
        return None
    told = "; ".join(f"{row.name} {row.mean:.0f}% ({row.low:.0f}% to {row.high:.0f}%)" for row in rows)
    figure = interval_plot(rows, label="Gap closed on held-out data (%)", null=0.0, bounds=(0.0, 100.0))
    return Chart(
        inline_svg(figure, f"Share of the gap closed: {told}."),
        "How much of the gap each cause closes when it is added alone, with 90% intervals.",
    )


def remainder_chart(report: Report) -> Chart | None:
    """What the model of the remainder closes, with its interval."""
    remainder = report.get("remainder")
    shares = _in_percent(remainder["closed_fraction"]) if remainder else None
    if shares is None:
        return None
    row = IntervalRow("With what is left modelled at its site", *shares)
    figure = interval_plot(
        [row], label="Of what is left, closed on held-out data (%)", null=0.0, bounds=(0.0, 100.0)
    )
    told = f"Share of what is left that is closed: {row.mean:.0f}% ({row.low:.0f}% to {row.high:.0f}%)."
    return Chart(
        inline_svg(figure, told), "Dot: best estimate. Bar: 90% interval. Below 0: it makes things worse."
    )


def _in_percent(closed: Interval | None) -> tuple[float, float, float] | None:
    """Mean, low and high of a share in percent; None where one of them is not determined."""
    if closed is None or closed["mean"] is None or closed["low"] is None or closed["high"] is None:
        return None
    return 100 * closed["mean"], 100 * closed["low"], 100 * closed["high"]


def plan_charts(report: Report, gap: xr.DataTree | None) -> list[Chart]:
    """The links seen from above, before and after, in the same colours."""
    data = group(gap, "links", report)
    if not {"rx_position", "tx_position", "before"} <= set(data):
        return []
    data = data.dropna(str(data["before"].dims[0]))
    if not data["before"].size:
        return []
    views = [name for name in ("before", "after") if name in data]
    classes = classes_for(*(data[name].values for name in views))
    return [
        Chart(
            inline_svg(
                plan_view(
                    data["rx_position"].values,
                    data["tx_position"].values,
                    data[name].values,
                    classes=classes,
                    label="Excess of each link (nats per observation)",
                ),
                _plan_alt(data[name], data["rx_position"].values, name),
            ),
            f"{_WHEN[name]}. {_DOTS}",
        )
        for name in views
    ]


def scene_charts(report: Report, gap: xr.DataTree | None) -> list[Chart]:
    """The paths of a traced scene and the objects that they meet, before and after, in the same colours."""
    if gap is None or "paths" not in gap.children:
        return []
    data = gap["paths"].to_dataset()
    views = ["before"] if report["gap"]["after"] is None else ["before", "after"]
    shown = {name: scene(data, name) for name in views}
    if not shown["before"].lines:
        return []
    classes = classes_for(*(one.excess for one in shown.values()))
    ends = [np.unique(data[name].values[:, :2], axis=0) for name in ("tx_position", "rx_position")]
    return [
        Chart(
            inline_svg(
                scene_view(one, ends[0], ends[1], classes=classes),
                f"Scene from above, {_WHEN[name].lower()}: {len(one.lines)} paths{_carriers(one)}.",
            ),
            f"{_WHEN[name]}. {_LINES}",
        )
        for name, one in shown.items()
    ]


def _carriers(shown: Scene) -> str:
    """`; share of the excess on paths by way of wall 2 93%`; nothing where all paths are direct."""
    told = listing(f"{words(name)} {100 * share:.0f}%" for name, _, _, share in shown.objects[:4])
    return f"; share of the excess on paths by way of {told}" if told else ""


_LINES = (
    "Lines are the paths that carry most of the gap, stronger where they carry more; grey ones fit. Squares are points on "
    "objects; in percent: the part of the twin's excess that lies on paths by way of the object."
)
_DOTS = "Dots are receivers, triangles transmitters. The larger and stronger a dot, the worse its fit."
_WHEN = {"before": "The twin as it is", "after": "With the cause added"}


def _plan_alt(value: xr.DataArray, rx_position: np.ndarray, name: str) -> str:
    worst = int(np.argmax(value.values))
    x, y = rx_position[worst, :2]
    median = number(float(np.median(value.values)))
    return (
        f"Plan view, {_WHEN[name].lower()}: {value.size} links, median excess {median} nats per observation, "
        f"worst {number(float(value.values[worst]))} at x {x:.1f} m, y {y:.1f} m."
    )


def all_charts(report: Report, gap: xr.DataTree | None) -> Iterator[tuple[str, Chart]]:
    """Every figure of the page with the section it belongs to."""
    yield from (("coordinates", chart) for chart in coordinate_charts(report, gap))
    yield from (("closed", chart) for chart in closed_charts(report, gap))
    yield from (("differences", chart) for chart in difference_charts(report, gap))
    if is_quiet(report):  # bars and colours would make noise look like a finding
        return
    yield from (("plan", chart) for chart in plan_charts(report, gap))
    yield from (("scene", chart) for chart in scene_charts(report, gap))
    rest = remainder_chart(report)
    yield from (("remainder", chart) for chart in (rest,) if chart is not None)
    yield from (("far", chart) for chart in (gap_chart(report), closing_chart(report)) if chart is not None)
