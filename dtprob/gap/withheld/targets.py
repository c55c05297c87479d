"""What diagnoses of withheld cases are to reach, over all strata that a target speaks of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from dtprob.gap.withheld.answers import Answer
from dtprob.gap.withheld.rates import median, most, over_limit, rate, ratio, share_within

SINGLE: Final = ("listed", "alias")
SETS: Final = ("pair", "triple")


class Target(NamedTuple):
    """A number over some cases that is to lie within limits.

    Attributes:
        name: what it is.
        kinds: of cases.
        from_lambda: cases with effects at least this informative.
        values: what an answer adds to it.
        lowest, highest: the limits; None where there is none on that side.
        summary: of all that answers add: a value with its interval.
        to_lambda: cases with effects at most this informative.
    """

    name: str
    kinds: Sequence[str]
    from_lambda: float
    values: Callable[[Answer], Sequence[Any]]
    lowest: float | None
    highest: float | None
    summary: Callable[[Sequence[Any]], dict[str, Any]] = rate
    to_lambda: float = float("inf")


NOT_IMITATED: Final = 64.0
"""Lambda that no single candidate explains, from which on a cause that the library lacks is to be called so."""


def _resolved(answer: Answer) -> list[bool]:
    return [answer.is_right] if answer.is_resolvable else []


def _called(answer: Answer) -> list[bool]:
    return [answer.is_unlisted] if answer.unexplained >= NOT_IMITATED else []


def _named(answer: Answer) -> Sequence[tuple[float, float]]:
    return answer.over_limit(lambda limit: limit.named)


def _cells(answer: Answer) -> Sequence[tuple[float, float]]:
    return [(score, 1.0) for score in answer.cell_scores()]


def _seconds(answer: Answer) -> Sequence[float]:
    return [] if answer.seconds is None else [answer.seconds]


TARGETS: Final = (
    Target("alarm without a gap", ("null",), 0.0, Answer.alarms, 0.0, 0.01),
    Target("alarm without a gap, upper limit", ("null",), 0.0, Answer.alarms, 0.0, 0.015, most),
    Target("right effect first", SINGLE, 100.0, lambda a: [a.is_right], 0.975, 1.0),
    Target("truth in the class", (*SINGLE, *SETS), 50.0, lambda a: [a.is_in_class], 0.99, 1.0),
    Target("exact set of two", ("pair",), 80.0, lambda a: [a.is_right], 0.98, 1.0),
    Target("exact set of three", ("triple",), 80.0, lambda a: [a.is_right], 0.96, 1.0),
    Target("wrong among the named of sets", SETS, 80.0, Answer.wrong_names, 0.0, 0.02, share_within),
    Target("exact set of two, resolvable", ("pair",), 80.0, _resolved, 0.98, 1.0),
    Target("exact set of three, resolvable", ("triple",), 80.0, _resolved, 0.96, 1.0),
    Target("unlisted called so", ("unlisted",), 64.0, lambda a: [a.is_unlisted], 0.97, 1.0),
    Target("unlisted called so, not imitated", ("unlisted",), 64.0, _called, 0.97, 1.0),
    Target("called unlisted and is not", ("null", *SINGLE, *SETS), 0.0, Answer.calls_unlisted, 0.0, 0.01),
    Target("right site of what is unlisted", ("unlisted",), 64.0, Answer.right_site, 0.90, 1.0),
    Target("right site of what is listed", (*SINGLE, *SETS), 100.0, Answer.right_site, 0.95, 1.0),
    Target("size in its 90% interval", SINGLE, 0.0, Answer.covered_size, 0.88, 0.93),
    Target("closed fraction in its 90% interval", (*SINGLE, *SETS), 0.0, Answer.covered_fraction, 0.88, 0.93),
    Target("closed fraction of .98 or more", (*SINGLE, *SETS), 100.0, Answer.closes(0.98), 0.5, 1.0),
    Target("closed fraction of .90 or more", (*SINGLE, *SETS), 100.0, Answer.closes(0.90), 0.9, 1.0),
    *(
        Target(
            f"right effect first over the best possible, lambda {size:g}",
            SINGLE,
            size,
            _named,
            0.97,
            None,
            over_limit,
            to_lambda=size,
        )
        for size in (10.0, 25.0, 50.0)
    ),
    Target(
        "right effect first by its score over the best possible",
        SINGLE,
        10.0,
        Answer.screened_over_limit,
        0.97,
        None,
        over_limit,
        to_lambda=50.0,
    ),
    Target(
        "size of the class over the best possible", SINGLE, 50.0, Answer.class_over_limit, None, 1.2, ratio
    ),
    Target("F1 of the cells touched", (*SINGLE, *SETS, "unlisted"), 100.0, _cells, 0.85, None, ratio),
    Target(
        "width of the closed fraction's interval",
        (*SINGLE, *SETS),
        100.0,
        Answer.width,
        None,
        0.3,
        median,
        to_lambda=100.0,
    ),
    Target("the same where more can be told", (*SINGLE, *SETS), 400.0, Answer.width, None, 0.1, median),
    Target(
        "closed by the model of the remainder",
        ("unlisted",),
        0.0,
        Answer.remainder_closed,
        0.75,
        None,
        median,
    ),
    Target("seconds of one case", ("null", *SINGLE, *SETS, "unlisted"), 0.0, _seconds, None, 20.0, median),
)
"""From which lambda on, and which number; a median of .98 is half of the cases at .98 or more. Seconds are those of the
machine and the load that they were measured under."""


def against_targets(
    answers: Sequence[Answer], rivals: Mapping[str, Sequence[Answer]]
) -> list[dict[str, Any]]:
    """Each target that the cases can tell of, with the number of the diagnosis and of each rival.

    Args:
        answers: of the diagnosis.
        rivals: answers of each rival.
    """
    lines = []
    for target in TARGETS:
        found = _reached(target, answers)
        if found is not None:
            theirs = {rival: _reached(target, said) for rival, said in rivals.items()}
            goal = {"lowest": target.lowest, "highest": target.highest}
            last = None if target.to_lambda == float("inf") else target.to_lambda
            span = {"from_lambda": target.from_lambda, "to_lambda": last}
            about = {"name": target.name, **span, "target": goal}
            lines.append({**about, **found, "rivals": {n: r for n, r in theirs.items() if r is not None}})
    return lines


def _reached(target: Target, answers: Sequence[Answer]) -> dict[str, Any] | None:
    """The number of a target; None where no answer adds to it."""
    asked = [a for a in answers if a.kind in target.kinds]
    asked = [a for a in asked if target.from_lambda <= a.lambda_ <= target.to_lambda]
    values = [value for answer in asked for value in target.values(answer)]
    return target.summary(values) if values else None
