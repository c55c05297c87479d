"""From evidence to the verdict."""

from __future__ import annotations

from typing import Final

from dtprob.gap.diagnosis import Cause
from dtprob.gap.evidence import Evidence
from dtprob.gap.how_far.terms import is_within
from dtprob.gap.settings import Settings
from dtprob.gap.vocabulary import Verdict

_SOME: Final = 0.2
"""Share of the gap that causes close at least, surely, where what is left is of another kind."""
_IDLE: Final = 0.5
"""Share of what a cause had gained below which it does little beside a model of what it leaves."""
_NO_NOISE: Final = 1e-6
"""P-value of what is left below which a noise that differs between clusters is none: whatever is wrong looks like it."""


def decide(evidence: Evidence, causes: tuple[Cause, ...], settings: Settings) -> Verdict:
    """The verdict, by the first of these rules that holds.

    ===  =============================================================================  =====================
    1    neither effects' scores nor sites show a gap at the base fit, or its held-out   NO_GAP
         error is below the tolerance
    2    no effect was accepted, and a site shows a gap                                  UNLISTED
    3    no effect was accepted                                                          UNDETERMINED
    4    the fraction that the cause closes is not established, and a site shows a gap   UNLISTED
         beside it
    5    the fraction is not established                                                 UNDETERMINED
    6    a site shows a gap beside the cause, and the cause closes too little of it, or  UNLISTED
         is a random field too large to be plausible, or noise that hides a wrong law
    7    other causes are as good, and this one leaves something that a site shows       UNLISTED
    8    other causes are as good                                                        UNDETERMINED
    9    the cause leaves something                                                      LISTED_WITH_REMAINDER
    10   else                                                                            LISTED
    ===  =============================================================================  =====================

    The fraction is that of known entries of random fields (`Cause.explained`). Too little is less than
    `Settings.relevance`, of random fields `field_relevance`; not where the cause surely closes a part and all that is
    left is how observations spread. A cause leaves something where a site shows it or a candidate is still asked for,
    and it closes less than all but `Settings.minor` or is a random field.
    """
    level = settings.level / 2
    if not evidence.steps[0].view.alarmed(settings) or _negligible(evidence, settings):
        return "NO_GAP"
    if not causes:
        return "UNLISTED" if evidence.before.site_p_value <= level else "UNDETERMINED"
    cause = causes[0]
    remains = evidence.after.site_p_value <= level
    explained = cause.explained
    if explained is None:
        return "UNLISTED" if remains else "UNDETERMINED"
    is_poor = explained.mean < _relevance(evidence, settings)
    is_poor = is_poor and not (explained.low >= _SOME and _leaves_moments(evidence, level))
    is_too_large = not cause.plausible and _are_fields(evidence)
    if remains and (is_poor or is_too_large or _hides(evidence, level)):
        return "UNLISTED"
    is_left = remains or bool(evidence.asked_for)
    leaves = is_left and (explained.mean < 1 - settings.minor or _are_fields(evidence))
    if cause.probability < settings.credibility:
        return "UNLISTED" if leaves and remains else "UNDETERMINED"
    return "LISTED_WITH_REMAINDER" if leaves else "LISTED"


def _leaves_moments(evidence: Evidence, level: float) -> bool:
    """Whether all that is left is how observations spread, of which causes that move expectations are no imitation."""
    left = [s for s in evidence.after.sites if s.p_value <= level and not s.last]
    locating = evidence.steps[0].view.screening.scores.locating
    moves = not locating.isdisjoint(evidence.accepted)
    return bool(left) and moves and not any(s.is_of_values for s in left)


def _hides(evidence: Evidence, level: float) -> bool:
    """Whether all that was named is how observations spread, which hides a wrong law of their values.

    Beside a twin that is far too sure of itself any noise closes nearly all of a gap. It hides one where it is idle beside
    a model of what it leaves; and a random one, which each cluster has of its own, where that is no noise beyond doubt:
    one receiver that stands elsewhere seems to be a noisy one.
    """
    locating = evidence.steps[0].view.screening.scores.locating
    wrong = [s for s in evidence.after.sites if s.p_value <= level and (s.is_of_values or s.is_dependence)]
    if not wrong or not locating.isdisjoint(evidence.accepted):
        return False
    if _are_fields(evidence) and min((s.p_value for s in wrong if not s.last), default=1.0) <= _NO_NOISE:
        return True
    if evidence.remainder is None or not any(s.is_of_values for s in wrong):
        return False
    gained = evidence.fitted.log_evidence - evidence.base.log_evidence
    return evidence.remainder.beside < _IDLE * gained


def _relevance(evidence: Evidence, settings: Settings) -> float:
    """Share of the gap below which causes that leave something are no explanation; random fields imitate much."""
    return max(settings.relevance, settings.field_relevance) if _are_fields(evidence) else settings.relevance


def _are_fields(evidence: Evidence) -> bool:
    """Whether all that was accepted are random fields, which close much of any gap by allowing for it."""
    return all(e.kind == "variance" for e in evidence.problem.effects if e.name in evidence.accepted)


def _negligible(evidence: Evidence, settings: Settings) -> bool:
    """Whether the base model's held-out error is already below what the user cares about."""
    tolerance = settings.tolerance_db
    return tolerance is not None and is_within(evidence.problem, evidence.held_before, tolerance)
