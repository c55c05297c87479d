"""What is said where no gap was found: what was tried, what would have been seen, and what came near to one."""

from collections.abc import Iterable

from dtprob.report.detectable import detectable_families
from dtprob.report.json_schema import Candidate, Detectable, Report, Site
from dtprob.report.names import LEVEL, listing, located_words, whereabouts, words
from dtprob.report.units import DASH, p_value


def nearly(report: Report) -> Site | None:
    """The site that differs by what may be more than chance, though too little to be called a gap; None where none does."""
    return _least((site["p_value"], site) for site in report["where"]["sites"])


def nearest(report: Report) -> Candidate | None:
    """The effect that the data call for by what may be more than chance among all that were tried; None where none does."""
    return _least((row["adjusted_p_value"], row) for row in report.get("screening", []) if _is_judged(row))


def _least[T](told: Iterable[tuple[float | None, T]]) -> T | None:
    """What has the smallest p-value, if that may be more than chance."""
    known = ((p, one) for p, one in told if p is not None)
    p, one = min(known, key=lambda pair: pair[0], default=(1.0, None))
    return one if p < LEVEL else None


def _is_judged(row: Candidate) -> bool:
    return not row.get("absorbed_by")


def nothing_found(report: Report) -> str:
    """What a diagnosis that found no gap has tried, and how sure it is."""
    screened, near = report.get("screening", []), nearly(report)
    if not screened:
        rest = (
            ""
            if near is not None
            else "; the twin's own quantities differ from the data by no more than chance"
        )
        return f"No effects were given to try{rest}.{_doubt(near)}"
    judged, candidate = sum(map(_is_judged, screened)), nearest(report)
    called = "" if candidate is None else _called_for(candidate)
    return f"{_tried(judged, near)}{_doubt(near)}{called} {_seen(report['detectable'])}"


def _tried(judged: int, near: Site | None) -> str:
    """That so many effects were tried and none is needed."""
    if not judged:
        return f"No known effect could be tried{'; nothing was left over' * (near is None)}."
    one = "1 known effect was tried; it is not"
    many = f"{judged} known effects were tried; none of them is"
    rest = ", and nothing else was left over" if near is None else ""
    return f"{one if judged == 1 else many} needed to explain these data{rest}."


def _doubt(near: Site | None) -> str:
    """What came near to a gap, and where."""
    if near is None:
        return ""
    where, p = f"{located_words(near)}{whereabouts(near)}", p_value(near["p_value"])
    return f" What is left in the {where} may be more than chance (p = {p}), but is too little to be called a gap."


def _called_for(candidate: Candidate) -> str:
    """Which effect came near to being a cause."""
    who, p = words(candidate["effect"]), p_value(candidate["adjusted_p_value"])
    return f" Of the known effects the data call most for {who}, which may be chance (p = {p} among all that were tried)."


def _seen(detectable: list[Detectable]) -> str:
    families = [entry for entry in detectable_families(detectable) if entry.size != DASH]
    some = [f"{entry.name} of {entry.size}" for entry in families[:3]]
    if not some:
        return "How large an effect would have been seen is not known."
    return f"Effects of these sizes would have been seen nine times in ten: {listing(some)}. Smaller ones may be there."
