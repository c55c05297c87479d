"""What to do next, in plain words: the measurement that tells explanations apart, or where to look for an unknown cause."""

from collections.abc import Mapping, Sequence
from typing import Any

from dtprob.gap.vocabulary import READ_TWICE
from dtprob.report.json_schema import Report, Site
from dtprob.report.names import block, detail, listing, located_words, significant, words

_SUCH = {
    "repeats": "a receiver at its limit, a sensor that is stuck, a default where nothing was measured",
    "skewness": "some readings err to one side: a path without line of sight, interference, losses",
    "tails": "a few readings are farther off than others, or none is",
    "dispersion": "a schedule or an average makes it more even than chance",
}
"""What makes such a moment wrong, mostly."""
_MUCH = 1.5
"""Times as much that everything again costs from which that is told."""


LEAVE_OUT = "Leave out the copies, readings that are in the data twice, and diagnose again: copies make gaps of their own."


def copies(report: Report) -> list[str]:
    """What warnings say of readings that are in the data twice, as those of a log that was read twice."""
    warnings = report["fit"].get("warnings", []) if "fit" in report else []
    return [warning for warning in warnings if READ_TWICE in warning]


def rivals(report: Report) -> list[list[str]]:
    """The sets of effects that compete for the first place: the first, its aliases, other likely ones."""
    if not report["causes"]:
        return []
    first = report["causes"][0]
    likely = [cause["effects"] for cause in report["causes"][1:] if cause["probability"] >= 0.05]
    found: list[list[str]] = []
    for effects in [first["effects"], *first["alias_class"], *likely]:
        if sorted(effects) not in [sorted(other) for other in found]:
            found.append(effects)
    return found


def next_step(report: Report) -> str | None:
    """The next measurement in a sentence or two, or None where there is none.

    Besides text it may be a mapping with a `description`, or with a `design` (coordinates), its `repeats`, and whether it
    `resolves`.
    """
    plan = report["next_measurement"]
    if not isinstance(plan, Mapping):
        return plan
    if "design" not in plan:
        return plan.get("description")
    where = {axis: value for axis, value in plan["design"].items() if axis != "design"}
    place = listing(f"{words(axis)}{_places(value)}" for axis, value in where.items())
    offered = plan["design"].get("design")
    place = f"{place} of the design {words(offered)}" if offered else place
    if not plan.get("resolves", True):
        return f"No measurement that is known of tells the explanations apart, however often made; nearest: {place}."
    times = plan.get("repeats", 1)
    if plan.get("everything"):
        return f"Measure everything again{f' {times} times' * (times > 1)}: no few places decide for less."
    each = " each" * any(isinstance(value, list | tuple) and len(value) > 1 for value in where.values())
    many = f" {times} times{each}" if times > 1 else ""
    again = "" if offered else " again"
    alone = [] in plan.get("split", [])
    why = "there it would show most" if alone else "there the explanations differ most"
    return f"Measure {place}{again}{many}: {why}.{_saved(plan)}"


def _places(value: Any) -> str:
    """` 3`, or `s 3 and 5`."""
    if isinstance(value, list | tuple):
        return f"{'s' * (len(value) > 1)} {listing(map(detail, value))}"
    return f" {detail(value)}"


def next_look(report: Report) -> str:
    """Where to look for an unknown cause: the block of the data that shows it most, the quantity that must change."""
    if copies(report):
        return LEAVE_OUT
    blocks, left = significant(report["where"]["coordinates"]), left_over(report)
    where = (
        f" at {block(max(blocks, key=lambda b: b['share'] or 0.0))}, where the gap shows most"
        if blocks
        else ""
    )
    there = " there" if where else ""
    what = f" Look for what could {changed(left[:1])}{there}." if left else ""
    if not where and not what:
        return "No measurement is proposed."
    return f"No measurement tells unknown causes apart. Look again{where or ' at the data'}.{what}"


def changed(sites: Sequence[Site]) -> str:
    """`change the path delays and cause the dependence of the delay on RSS`."""
    return listing(map(_changed, sites))


def _changed(site: Site) -> str:
    what = site.get("moment", "values").partition(" ")[0]
    verb = "cause" if what in ("dependence", "repeats") else "change"
    such = f" ({_SUCH[what]})" if what in _SUCH else ""
    return f"{verb} the {located_words(site)}{such}"


def _saved(plan: Mapping[str, Any]) -> str:
    """How much less that costs than everything again, where that is much."""
    if "cost_of_all_again" not in plan:
        return ""
    everything = plan["cost_of_all_again"]
    if everything is None:
        return " Measuring everything again would not decide."
    times = everything / plan["cost"]
    return f" Everything again would cost {times:.0f} times as much." if times >= _MUCH else ""


def decides(plan: Mapping[str, Any] | str | None) -> tuple[bool, bool]:
    """Whether a proposed measurement decides, and whether more data of the same kind do, unless the plan denies it."""
    if not isinstance(plan, Mapping):
        return True, True
    resolves = bool(plan.get("resolves", True))
    return resolves, resolves and plan.get("cost_of_all_again", 0.0) is not None


def left_over(report: Report) -> list[Site]:
    """The sites at which something is left, each once, as it is most surely wrong."""
    names, located = report["unlisted"]["sites"], report["unlisted"].get("located", [])
    first = {site["site"]: site for site in reversed(located)}
    return [first.get(name, {"site": name, "p_value": None, "share": None}) for name in names]
