"""How good diagnoses of withheld cases are: counts per stratum with exact binomial intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import stats

from dtprob.errors import InputError

type Report = Mapping[str, Any]
type Truth = Mapping[str, Any]

LEVEL: Final = 0.95
_HAS_CAUSE: Final = ("LISTED", "LISTED_WITH_REMAINDER")
_LISTED_KINDS: Final = ("listed", "pair", "triple", "alias")


@dataclass(frozen=True)
class Rate:
    """A share of cases with its two-sided 95% Clopper-Pearson interval.

    Attributes:
        count: how many.
        of: among how many; at least 1.
    """

    count: int
    of: int

    @property
    def value(self) -> float:
        """The share."""
        return self.count / self.of

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper limit of the probability."""
        tail = (1 - LEVEL) / 2
        low = stats.beta.ppf(tail, self.count, self.of - self.count + 1) if self.count else 0.0
        high = stats.beta.isf(tail, self.count + 1, self.of - self.count) if self.count < self.of else 1.0
        return float(low), float(high)

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        low, high = self.interval
        return {"count": self.count, "of": self.of, "rate": self.value, "low": low, "high": high}


@dataclass(frozen=True)
class Answer:
    """What was said about one case, beside what is true.

    Attributes:
        name: of the case.
        truth: its record in the key.
        report: the content of its report.json; None where the diagnosis failed.
    """

    name: str
    truth: Truth
    report: Report | None

    @property
    def verdict(self) -> str:
        """The verdict, or FAILED."""
        return "FAILED" if self.report is None else str(self.report["verdict"])

    @property
    def effects(self) -> frozenset[str]:
        """The true effects, by their full names."""
        return frozenset(str(effect["name"]) for effect in self.truth["effects"])

    @property
    def first(self) -> Mapping[str, Any] | None:
        """The most probable cause, if any is given."""
        causes = [] if self.report is None else self.report["causes"]
        return causes[0] if causes else None

    @property
    def named(self) -> frozenset[str]:
        """The effects of the most probable cause."""
        return frozenset(self.first["effects"]) if self.first else frozenset()

    @property
    def alias_class(self) -> list[frozenset[str]]:
        """All sets of effects that the answer holds possible."""
        return [frozenset(item) for item in self.first["alias_class"]] if self.first else []


def is_alarm(answer: Answer) -> bool:
    """Whether a gap is claimed."""
    return answer.verdict not in {"NO_GAP", "FAILED"}


def is_right(answer: Answer) -> bool:
    """Whether the most probable cause is exactly the true set of effects."""
    return answer.named == answer.effects


def is_right_family(answer: Answer) -> bool:
    """Whether the families are right, whatever the instance, such as the wall or the antenna."""
    return _families(answer.named) == _families(answer.effects)


def is_in_class(answer: Answer) -> bool:
    """Whether the true set is among those that the answer holds possible."""
    return answer.effects in answer.alias_class or is_right(answer)


def is_listed(answer: Answer) -> bool:
    """Whether a known cause is named."""
    return answer.verdict in _HAS_CAUSE


def is_unlisted(answer: Answer) -> bool:
    """Whether the verdict says that the cause is not among the candidates."""
    return answer.verdict == "UNLISTED"


def _families(names: frozenset[str]) -> frozenset[str]:
    return frozenset(name.split("[")[0] for name in names)


_MEASURES: Final[Mapping[str, Mapping[str, Callable[[Answer], bool]]]] = {
    "null": {"alarm": is_alarm},
    "listed": {
        "right effect first": is_right,
        "right family first": is_right_family,
        "truth in the class": is_in_class,
        "verdict names a cause": is_listed,
        "missed": lambda answer: answer.verdict == "NO_GAP",
    },
    "unlisted": {
        "says unlisted": is_unlisted,
        "names a wrong cause": is_listed,
        "missed": lambda answer: answer.verdict == "NO_GAP",
    },
}


def score(key: Mapping[str, Any], reports: Mapping[str, Report | None]) -> dict[str, Any]:
    """Score answers against their key.

    Args:
        key: content of key.json: `cases`, each with `name`, `kind`, `lambda` and `effects`.
        reports: content of report.json by the case's name; None where the diagnosis failed.

    Returns:
        `strata`, per kind and lambda: number of cases, verdicts, rates with intervals, alias class size and
        closed fraction; `cases`, what was said of each; `missing`, the cases without an answer.

    Raises:
        InputError: the key is none, or no case has an answer.
    """
    truths = _truths(key)
    answers = [Answer(name, truth, reports[name]) for name, truth in truths.items() if name in reports]
    if not answers:
        raise InputError(
            "answers", "a report for cases of this key", "none", "Give the folder of the answers"
        )
    strata: dict[tuple[str, float], list[Answer]] = {}
    for answer in answers:
        size = 0.0 if answer.truth["kind"] == "null" else float(answer.truth.get("lambda") or 0.0)
        strata.setdefault((answer.truth["kind"], size), []).append(answer)
    return {
        "format": "dtprob.score",
        "version": 1,
        "strata": [_stratum(kind, size, group) for (kind, size), group in sorted(strata.items())],
        "cases": [_line(answer) for answer in answers],
        "missing": [name for name in truths if name not in reports],
    }


def _truths(key: Mapping[str, Any]) -> dict[str, Truth]:
    try:
        truths = {str(case["name"]): case for case in key["cases"]}
        for truth in truths.values():
            _ = truth["kind"], [effect["name"] for effect in truth["effects"]]
    except (KeyError, TypeError) as error:
        expected = "`cases`, each with name, kind, lambda and effects"
        raise InputError("key", expected, f"none of {error}", "Give the key.json of these cases") from error
    return truths


def _stratum(kind: str, size: float, answers: Sequence[Answer]) -> dict[str, Any]:
    group = "listed" if kind in _LISTED_KINDS else kind
    rates = {
        name: Rate(sum(map(test, answers)), len(answers)).to_dict()
        for name, test in _MEASURES.get(group, {"alarm": is_alarm}).items()
    }
    verdicts = sorted({answer.verdict for answer in answers})
    counts = {verdict: sum(a.verdict == verdict for a in answers) for verdict in verdicts}
    result: dict[str, Any] = {
        "kind": kind,
        "lambda": size,
        "cases": len(answers),
        "verdicts": counts,
        "rates": rates,
    }
    if group == "listed":
        right = [a.first for a in answers if is_right(a) and a.first]
        closed = [cause["closed_fraction"]["mean"] for cause in right if cause["closed_fraction"]]
        result["closed_fraction"] = _quantiles(closed)
        result["class_size"] = _quantiles([len(a.alias_class) for a in answers if a.first])
    return result


def _quantiles(values: Sequence[float]) -> dict[str, float] | None:
    if not values:
        return None
    low, median, high = np.quantile(np.asarray(values, float), [0.1, 0.5, 0.9])
    return {"lowest_decile": float(low), "median": float(median), "highest_decile": float(high)}


def _line(answer: Answer) -> dict[str, Any]:
    return {
        "name": answer.name,
        "kind": answer.truth["kind"],
        "lambda": answer.truth.get("lambda"),
        "true": sorted(answer.effects),
        "verdict": answer.verdict,
        "named": sorted(answer.named),
        "probability": answer.first["probability"] if answer.first else None,
        "right": is_right(answer) if answer.truth["kind"] in _LISTED_KINDS else None,
    }
