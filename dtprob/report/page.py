"""The page that tells a diagnosis: one HTML file that needs nothing else."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import xarray as xr
from jinja2 import Environment, PackageLoader, StrictUndefined

from dtprob.gap.vocabulary import UNSEEN
from dtprob.report import names, sizes, units
from dtprob.report.charts import all_charts
from dtprob.report.detectable import detectable_families
from dtprob.report.json_schema import Candidate, Interval, Report, Tried, is_quiet, validate
from dtprob.report.next_step import copies, left_over, next_look, next_step, rivals
from dtprob.report.palette import DARK, LIGHT
from dtprob.report.quiet import nearly
from dtprob.report.story import tell

FIRST = 12


@dataclass(frozen=True)
class Bar:
    """An interval on a track that contains zero: positions in percent of the track."""

    low: float
    high: float
    mean: float
    zero: float


def render(report: Mapping[str, Any], gap: xr.DataTree | None, *, title: str) -> str:
    """The page of a diagnosis, as self-contained HTML.

    Args:
        report: the content of report.json.
        gap: the content of gap.nc, for maps and plan views; each of its groups and variables may be absent.
        title: what was diagnosed, for the page's heading.

    Returns:
        the text of an HTML file: no script, no request, readable on a telephone, in the dark and on paper.

    Raises:
        InputError: the report does not keep to `dtprob.report.json_schema.Report`.
    """
    checked = validate(report)
    charts = list(all_charts(checked, gap))
    candidates = ranked(checked.get("screening", []))
    return (
        environment()
        .get_template("page.html.jinja")
        .render(
            title=title,
            report=checked,
            quiet=is_quiet(checked),
            story=tell(checked),
            next_step=next_step(checked),
            rivals=rivals(checked),
            others=others(checked),
            left_over=left_over(checked),
            nearly=nearly(checked),
            copies=copies(checked),
            next_look=next_look(checked),
            charts={section: [chart for name, chart in charts if name == section] for section, _ in charts},
            candidates=candidates,
            judged=sum(not candidate.get("absorbed_by") for candidate in candidates),
            detectable=detectable_families(checked["detectable"]),
            light=LIGHT,
            dark=DARK,
            first=FIRST,
        )
    )


def bar(size: Interval) -> Bar | None:
    """Where an interval lies on a track that also shows zero, with a margin at both ends; None if unbounded."""
    least, mean, most = size["low"], size["mean"], size["high"]
    if least is None or mean is None or most is None:
        return None
    low, high = min(least, mean, 0.0), max(most, mean, 0.0)
    span = (high - low) or 1.0
    low, span = low - 0.06 * span, 1.12 * span
    place = [round(100 * (value - low) / span, 2) for value in (least, most, mean, 0.0)]
    return Bar(place[0], place[1], place[2], place[3])


def others(report: Report) -> list[tuple[Tried, float, str]]:
    """The sets that were fitted beside the named one, with their share of its gain and by how much they are less likely.

    None where no cause is named; those that are just as possible are told as such. What holds the named one and more is
    no other explanation: what is more in it brings too little.
    """
    tried = report.get("tried", [])
    if report["verdict"] not in {"LISTED", "LISTED_WITH_REMAINDER"} or not tried:
        return []
    named = set(report["causes"][0]["effects"])
    possible = [named, *map(set, report["causes"][0]["alias_class"])]
    most = max(next((t["gain_nats"] for t in tried if set(t["effects"]) == named), 0.0), 1e-9)
    rest = [t for t in tried if set(t["effects"]) not in possible]
    more = "the rest brings too little"
    return [
        (
            t,
            min(max(t["gain_nats"] / most, 0.0), 1.0),
            more if named < set(t["effects"]) else units.odds(t["behind_nats"]),
        )
        for t in rest
    ]


def ranked(candidates: Sequence[Candidate]) -> list[Candidate]:
    """The candidates from the most to the least significant; those that could not be judged come last."""

    def rank(candidate: Candidate) -> tuple[bool, float, float]:
        adjusted, z = candidate["adjusted_p_value"], candidate["z"]
        untold = bool(candidate.get("absorbed_by"))
        return (untold, 2.0 if adjusted is None else adjusted, 0.0 if z is None else -abs(z))

    return sorted(candidates, key=rank)


def environment() -> Environment:
    """The templates, with the filters and functions that they use."""
    made = Environment(
        loader=PackageLoader("dtprob.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {function.__name__: function for function in _FILTERS}
    made.globals |= dict[str, Any]({function.__name__: function for function in _FUNCTIONS}, UNSEEN=UNSEEN)
    return made


_FILTERS: tuple[Callable[..., Any], ...] = (
    units.percent,
    units.chance,
    units.p_value,
    units.number,
    names.words,
    names.site_words,
    names.located_words,
    names.place_words,
    names.whereabouts,
    names.allowance,
    names.together,
    names.listing,
    names.capital,
    names.block,
    names.aliases,
    names.term,
    names.shares,
    names.significant,
    names.detail,
    names.spoken,
    bar,
)
_FUNCTIONS: tuple[Callable[..., Any], ...] = (
    sizes.size_reading,
    names.user_terms,
    sizes.apart,
    units.reading,
)
