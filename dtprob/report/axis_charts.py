"""The figures of a page over the data's coordinates: the gap, data against the twin, and what a cause closes where."""

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from dtprob.report.axis_figures import coordinate_map, share_map, usual_limit
from dtprob.report.chart import Chart, group
from dtprob.report.json_schema import Report, is_quiet
from dtprob.report.names import capital, words
from dtprob.report.svg import inline_svg
from dtprob.report.units import number

_BEFORE, _AFTER = "gap_", "gap_after_"
_FOUND, _EXPECTED = "closed_", "closed_expected_"
_MOST_MAPS = 6
_MOST_SHARES = 4
_GROUPS = 24
"""Positions of which shares are drawn apart; of longer axes so many groups of neighbours."""


def coordinate_charts(report: Report, gap: xr.DataTree | None) -> list[Chart]:
    """A map of the gap over each axis that gap.nc holds, those that the report names first."""
    data = group(gap, "where", report)
    named = [axis.replace("/", ".") for entry in report["where"]["coordinates"] for axis in entry["axes"]]
    axes = [axis for axis in _axes(data, _BEFORE) if data[_BEFORE + axis].count() > 1]
    ordered = sorted(axes, key=lambda axis: named.index(axis) if axis in named else len(named))
    quiet = is_quiet(report)
    return [_coordinate_chart(data, axis, quiet=quiet, named=axis in named) for axis in ordered[:_MOST_MAPS]]


def difference_charts(report: Report, gap: xr.DataTree | None) -> list[Chart]:
    """Data less twin along each column of the data, in their own unit, with its sign."""
    data = group(gap, "differences", report)
    return [
        _difference_chart(data, i, report["provenance"].get("words", {}))
        for i in range(len(data.dims))
        if (data[f"before_{i}"] + data[f"spread_{i}"]).count()
    ]


def _difference_chart(data: xr.Dataset, index: int, spelt: Mapping[str, Sequence[str]]) -> Chart:
    place, before, spread = (data[f"{name}_{index}"].values for name in ("place", "before", "spread"))
    after, said = data.get(f"after_{index}"), data[f"place_{index}"].attrs
    name, unit = capital(words(str(said["column"]))), said["unit"]
    limit = usual_limit(int(said["of"])) * spread
    names = _names(place, spelt.get(str(said["column"]), ()))
    figure = coordinate_map(
        names,
        before,
        None if after is None else after.values,
        label=name,
        threshold=limit,
        amount=f"Data less twin ({unit})" if unit else "Data less twin",
    )
    far = int(np.nanargmax(np.abs(before) - limit))
    caption = (
        f"{name}: above 0 the data ({words(str(said['observed']))}) are larger than the twin says, on average. "
        "Grey: where all values along all columns stay, in 95 of 100 cases, when the twin is right."
    )
    top = names[far] if names.dtype.kind == "U" else number(float(place[far]))
    most = f"{number(float(before[far]))} at {top}"
    return Chart(inline_svg(figure, f"Data less twin along {words(str(said['column']))}: {most}."), caption)


def _names(place: np.ndarray, listed: Sequence[str]) -> np.ndarray:
    """Places of a column of words by their words; of others, and where places stand for several words, as they are."""
    number = place.astype(int)
    if not listed or np.any(number != place) or number.min() < 0 or number.max() >= len(listed):
        return place
    return np.array([listed[k] for k in number])


def _coordinate_chart(data: xr.Dataset, axis: str, *, quiet: bool, named: bool) -> Chart:
    shown = data[[name for name in (_BEFORE + axis, _AFTER + axis) if name in data and data[name].count()]]
    complete = shown.assign_coords(place=(axis, np.arange(shown.sizes[axis]))).dropna(axis)
    before, after, place = complete[_BEFORE + axis], complete.get(_AFTER + axis), complete["place"].values
    name, limit = capital(words(axis)), usual_limit(before.size)
    figure = coordinate_map(
        place,
        before.values,
        None if after is None else after.values,
        label=name,
        threshold=limit,
    )
    told = f"Gap over {words(axis)}: {_peak(before.values, place, 'before')}"
    if after is not None:
        told += f"; {_peak(after.values, place, 'after')}"
    caption = (
        f"{name}: how much more the data stray from the twin than they should. "
        "Grey: where all values stay, in 95 of 100 cases, when the twin is right."
    )
    unseen = data.sizes[axis] - complete.sizes[axis]
    if unseen:
        caption += f" {unseen} not shown: nothing was observed there."
    outside = bool((np.abs(before) > limit).any())
    if quiet and outside:
        caption += " One such figure in twenty has a value outside by chance."
    if not (quiet or named or outside):
        caption += f" No {words(axis)} stands out alone: the gap is a pattern across them."
    return Chart(inline_svg(figure, f"{told}."), caption)


def _peak(values: np.ndarray, place: np.ndarray, name: str) -> str:
    top = int(np.argmax(values))
    return f"{name}, the highest excess is {number(float(values[top]))} standard deviations at {place[top]}"


def _axes(data: xr.Dataset, prefix: str) -> list[str]:
    """The axes along which there is a variable that is called after its axis, with a prefix."""
    ends = ((str(name), str(one.dims[0])) for name, one in data.data_vars.items())
    return [axis for name, axis in ends if name == prefix + axis]


def closed_charts(report: Report, gap: xr.DataTree | None) -> list[Chart]:
    """How what the causes close is spread along the data's axes, those along which it is spread least evenly."""
    data = group(gap, "where", report)
    if not report["causes"]:
        return []
    axes = [axis for axis in _axes(data, _EXPECTED) if data[_EXPECTED + axis].count()]
    uneven = {axis: float(data[_EXPECTED + axis].max()) * data.sizes[axis] for axis in axes}
    return [_closed_chart(data, axis) for axis in sorted(axes, key=lambda a: -uneven[a])[:_MOST_SHARES]]


def _closed_chart(data: xr.Dataset, axis: str) -> Chart:
    parts = np.array_split(np.arange(data.sizes[axis]), min(data.sizes[axis], _GROUPS))
    middle = np.array([part.mean() for part in parts])
    found, expected = (
        np.array([100 * data[name + axis].values[part].sum() for part in parts])
        for name in (_FOUND, _EXPECTED)
    )
    spread = np.sqrt(2 * np.maximum(expected, 0) / 100 / float(data[_FOUND + axis].attrs["nats"]))
    reach = 100 * usual_limit(len(parts)) * spread
    name, far = capital(words(axis)), np.abs(found - expected) > reach
    figure = share_map(middle, found, expected, reach, label=name)
    most = int(np.argmax(expected))
    told = (
        f"What the cause closes over {words(axis)}: most at {number(float(middle[most]))}, where it should be "
        f"{expected[most]:.0f}% and is {found[most]:.0f}%."
    )
    caption = (
        f"{name}: how what the cause closes is spread. Grey: where all dots lie, in 95 of 100 cases, when the cause acts "
        "as it is said to."
    )
    if far.any():
        caption += " Dots outside: there the cause does not do what it should, and something else may stand behind it."
    return Chart(inline_svg(figure, told), caption)
