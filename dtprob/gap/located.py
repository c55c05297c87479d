"""Where the gap lies, as report.json tells it: over the model's sites and over the data's coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from dtprob.gap.evidence import Evidence
from dtprob.gap.tails import told_apart
from dtprob.gap.where.coordinates import CoordinateFinding
from dtprob.gap.where.locate import Location
from dtprob.gap.where.reach import Told, reached, told
from dtprob.gap.where.site_finding import SiteFinding

_TOLD: Final = 0.01
"""Probability up to which a site comes before those that have no more than a larger share."""
_LEAST_GAP: Final = 1.0
"""Nats of a gap of which a site, or a part of the data, can have a share."""


def along(evidence: Evidence) -> dict[str, Told]:
    """What each position along the data's axes tells of the accepted causes."""
    first, last = evidence.steps[0].view, evidence.last
    return told(first.problem, first.fitted, first.projection, last.problem, last.fitted)


def where(evidence: Evidence, told_along: Mapping[str, Told]) -> dict[str, Any]:
    """Sites, those that close most first, and blocks of the data's axes.

    Args:
        evidence: of the diagnosis.
        told_along: what each position along the axes tells of the accepted causes.
    """
    gap = evidence.floor.best - float(evidence.held_before.log_likelihood.sum())
    accepted = [e for e in evidence.problem.effects if e.name in evidence.accepted]
    sizes = sum(effect.dimension for effect in accepted if effect.kind == "mean")
    blocks = reached(told_along, evidence.problem.declaration.cluster, sizes)
    axes = {block.axis for block in blocks}
    others = [b for b in evidence.before.coordinates if b.axis not in axes]  # blocks whose misfit stands out
    share = evidence.fraction.mean if evidence.fraction is not None else 0.0
    closed = {site: share for effect in accepted for site in effect.sites}
    before = evidence.before.sites
    sites = zip(before, site_shares(before, gap, closed), strict=True)
    gained = {axis: float(here.gain.sum()) for axis, here in told_along.items()}
    is_known, there_is = evidence.fraction is not None, gap >= _LEAST_GAP
    return {
        "sites": [_located(*one) for one in sorted(sites, key=_rank)],
        "coordinates": [
            *(
                _block(b, share * _part_of(b.excess, gained[b.axis]) if is_known and there_is else None)
                for b in blocks
            ),
            *(_block(b, _part_of(b.excess, gap) if there_is else None) for b in others),
        ],
    }


def _part_of(nats: float, whole: float) -> float:
    """The share of a whole, nothing where it is none."""
    return min(max(nats, 0.0) / whole, 1.0) if whole > 0 else 0.0


def _block(found: CoordinateFinding, share: float | None) -> dict[str, Any]:
    parts = {"parts": [list(part) for part in found.parts]} if found.parts else {}
    return {"axes": {found.axis: [found.low, found.high]}, **parts, "p_value": found.p_value, "share": share}


def unlisted(after: Location, level: float) -> dict[str, Any]:
    """What is left over at the last fit: the sites at which it is, and how each of them is wrong."""
    left = [found for found in after.sites if found.p_value <= level]
    return {
        "p_value": after.site_p_value,
        "sites": list(dict.fromkeys(found.site for found in left)),
        "located": [_located(found, None) for found in left],
    }


def site_shares(found: Sequence[SiteFinding], gap: float, closed: Mapping[str, float]) -> list[float | None]:
    """The share of the gap that changing each site closes; None where there is no gap to share, or nothing to change.

    Args:
        found: the sites.
        gap: nats between the twin and the best that is known.
        closed: what the named effects close, for each site that they change.
    """
    return [
        max(min(one.gain / gap, 1.0), closed.get(one.site, 0.0))
        if one.gain is not None and gap >= _LEAST_GAP
        else None
        for one in found
    ]


def _rank(one: tuple[SiteFinding, float | None]) -> tuple[bool, bool, bool, float, float]:
    """Values by their shares, moments by their p-values; those that rounding alone parts stay in their order."""
    found, share = one
    closed = round(share or 0.0, 6) if found.moment is None else 0.0
    return not found.repeats, found.last, found.p_value > _TOLD, -closed, told_apart(found.p_value)


def _located(found: SiteFinding, share: float | None) -> dict[str, Any]:
    told = {"moment": found.moment, "whereabouts": found.whereabouts, "place": found.place}
    there: dict[str, Any] = {name: words for name, words in told.items() if words is not None}
    if found.spreads:
        there["spreads"] = True
    return {"site": found.site, "p_value": found.p_value, "share": share, "family": found.family, **there}
