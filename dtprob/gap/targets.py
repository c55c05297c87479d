"""What diagnoses of withheld cases are to reach, over all strata that a target speaks of."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from dtprob.gap.answers import Answer
from dtprob.gap.rates import rates

SINGLE: Final = ("listed", "alias")
SETS: Final = ("pair", "triple")


class Target(NamedTuple):
    """A share that is to lie within limits.

    Attributes:
        name: what is counted.
        kinds: of cases.
        from_lambda: of cases with effects at least this informative.
        test: outcomes of an answer.
        lowest, highest: the limits.
    """

    name: str
    kinds: Sequence[str]
    from_lambda: float
    test: Callable[[Answer], Iterable[bool]]
    lowest: float
    highest: float


TARGETS: Final = (
    Target("alarm without a gap", ("null",), 0.0, lambda a: [a.is_alarm], 0.0, 0.01),
    Target("right effect first", SINGLE, 100.0, lambda a: [a.is_right], 0.975, 1.0),
    Target("truth in the class", (*SINGLE, *SETS), 50.0, lambda a: [a.is_in_class], 0.99, 1.0),
    Target("exact set of two", ("pair",), 80.0, lambda a: [a.is_right], 0.98, 1.0),
    Target("exact set of three", ("triple",), 80.0, lambda a: [a.is_right], 0.96, 1.0),
    Target("wrong among the named of sets", SETS, 80.0, Answer.wrong_names, 0.0, 0.02),
    Target("unlisted called so", ("unlisted",), 64.0, lambda a: [a.is_unlisted], 0.97, 1.0),
    Target("called unlisted and is not", ("null", *SINGLE, *SETS), 0.0, lambda a: [a.is_unlisted], 0.0, 0.01),
    Target("right site of what is unlisted", ("unlisted",), 64.0, Answer.right_site, 0.90, 1.0),
    Target("right site of what is listed", (*SINGLE, *SETS), 100.0, Answer.right_site, 0.95, 1.0),
    Target("size in its 90% interval", SINGLE, 0.0, Answer.covered_size, 0.88, 0.93),
    Target("closed fraction in its 90% interval", (*SINGLE, *SETS), 0.0, Answer.covered_fraction, 0.88, 0.93),
    Target("closed fraction of .98 or more", (*SINGLE, *SETS), 100.0, Answer.closes(0.98), 0.5, 1.0),
    Target("closed fraction of .90 or more", (*SINGLE, *SETS), 100.0, Answer.closes(0.90), 0.9, 1.0),
)
"""From which lambda on, and which share; a median of .98 is half of the cases at .98 or more."""


def against_targets(
    answers: Sequence[Answer], rivals: Mapping[str, Sequence[Answer]]
) -> list[dict[str, Any]]:
    """Each target that the cases can tell of, with the share of the diagnosis and of each rival.

    Args:
        answers: of the diagnosis.
        rivals: answers of each rival.
    """
    lines = []
    for target in TARGETS:
        share = _share(target, answers)
        if share is not None:
            theirs = {rival: _share(target, said) for rival, said in rivals.items()}
            goal = {"lowest": target.lowest, "highest": target.highest}
            about = {"name": target.name, "from_lambda": target.from_lambda, "target": goal}
            lines.append({**about, **share, "rivals": {n: s for n, s in theirs.items() if s is not None}})
    return lines


def _share(target: Target, answers: Sequence[Answer]) -> dict[str, Any] | None:
    asked = [a for a in answers if a.kind in target.kinds and a.lambda_ >= target.from_lambda]
    return rates({target.name: target.test}, asked).get(target.name)
