"""Where to look first for an unknown cause: at what came closest, which is not noise where values are wrong."""

from dtprob.report.json_schema import Candidate, Cause, Report
from dtprob.report.names import LEVEL, listing, together, words
from dtprob.report.next_step import left_over
from dtprob.report.sizes import key_of, size_reading

_PLACE = ("x_m", "y_m", "z_m")
"""Sizes that say where in the scene an effect acts."""


def values_are_wrong(report: Report) -> bool:
    """Whether something is left at a site of values, and not only in how observations spread about them."""
    return any("moment" not in site and not site.get("spreads", False) for site in left_over(report))


def closest(report: Report) -> str:
    """Which effect to look at first where values are wrong, and where it acts: the best that moves them.

    Whatever is wrong looks like noise, so that noise comes closest to many causes, and says nothing of them.
    """
    if not values_are_wrong(report):
        return ""
    rows = {row["effect"]: row for row in report.get("screening", [])}
    cause = report["causes"][0] if report["causes"] else None
    moving = [e for e in cause["effects"] if e in rows and _moves(rows[e])] if cause else []
    if cause is None or not moving:
        best = _most_asked([row for row in rows.values() if _moves(row) and _is_shown(row)])
        return _look([words(best["effect"])]) if best is not None else ""
    placed = {effect: _place(effect, cause) for effect in moving}
    there = [f"{words(effect)}, at {where}" for effect, where in placed.items() if where]
    return _look(there or [together(moving)])


def beyond(report: Report) -> str:
    """The effect that the data ask for most, where they ask for more of it than its prior allows.

    Where values are wrong noise is none: a wider prior would let it hide them.
    """
    wrong = values_are_wrong(report)
    rows = [row for row in report.get("screening", []) if _moves(row) or not wrong]
    most = _most_asked(rows)
    far = most.get("beyond") if most is not None else None
    if most is None or far is None or most.get("opposite"):
        return ""
    return (
        f" Most of all the data ask for {words(most['effect'])}, but {far:.0f} times the size that its prior calls usual:"
        " if it can be so large, give it a wider prior and diagnose again."
    )


def _look(told: list[str]) -> str:
    """The first sentence of what to do."""
    return f"Look first at what came closest, though it does not explain all: {listing(told)}. "


def _moves(row: Candidate) -> bool:
    """Whether a candidate moves what is expected, and not only how observations spread."""
    return not row.get("spreads", False)


def _is_shown(row: Candidate) -> bool:
    adjusted = row["adjusted_p_value"]
    return adjusted is not None and adjusted <= LEVEL and not row.get("opposite")


def _most_asked(rows: list[Candidate]) -> Candidate | None:
    asked = [row for row in rows if row["z"] is not None and not row.get("absorbed_by")]
    return max(asked, key=lambda row: abs(row["z"] or 0.0), default=None)


def _place(effect: str, cause: Cause) -> str:
    """`x 38.1 m and y 13.1 m`, nothing where the effect has no place."""
    keys = [(name, key_of(effect, name, cause["size"])) for name in _PLACE]
    told = [
        f"{name[0]} {size_reading(name, cause['size'][key])[1].mean_with_unit}"
        for name, key in keys
        if key is not None
    ]
    return listing(told)
