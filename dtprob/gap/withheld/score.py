"""How good diagnoses of withheld cases are: counts per stratum with exact binomial intervals, rivals beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

from dtprob.errors import InputError, unknown_name
from dtprob.gap.withheld.answers import Answer, Report, Truth
from dtprob.gap.withheld.rates import quantiles, rates
from dtprob.gap.withheld.targets import against_targets

type Test = Callable[[Answer], Iterable[bool]]

_LISTED_KINDS: Final = ("listed", "pair", "triple", "alias")
_KINDS: Final = ("null", *_LISTED_KINDS, "unlisted")
SAME: Final = "dtprob, on the cases of the rivals"
"""What the diagnosis is called where it stands beside rivals that have not answered all cases."""
_SHARED: Final = ("screening", "provenance")
"""Parts of a report by which all methods are judged alike."""
_EXACT: Final[Mapping[str, Test]] = {
    "right effect first": lambda answer: [answer.is_right],
    "right family first": lambda answer: [answer.is_right_family],
    "truth in the class": lambda answer: [answer.is_in_class],
    "names a wrong effect": Answer.names_wrong,
    "verdict names a cause": lambda answer: [answer.is_listed],
    "says unlisted": lambda answer: [answer.is_unlisted],
    "missed": lambda answer: [answer.is_missed],
}
_MEASURES: Final[Mapping[str, Mapping[str, Test]]] = {
    "null": {
        "alarm": Answer.alarms,
        "says unlisted": Answer.calls_unlisted,
    },
    "listed": {
        **_EXACT,
        "alias in the class": Answer.names_alias,
        "right site first": Answer.right_site,
        "size in its 90% interval": Answer.covered_size,
        "closed fraction in its 90% interval": Answer.covered_fraction,
    },
    "unlisted": {
        "says unlisted": lambda answer: [answer.is_unlisted],
        "names a wrong cause": lambda answer: [answer.is_listed],
        "missed": lambda answer: [answer.is_missed],
        "right site first": Answer.right_site,
    },
}


def score(
    key: Mapping[str, Any],
    reports: Mapping[str, Report | None],
    rivals: Mapping[str, Mapping[str, Report]] = MappingProxyType({}),
    seconds: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, Any]:
    """Score answers against their key.

    Args:
        key: content of key.json: `cases`, each with `name`, `kind`, `lambda` and `effects`.
        reports: content of report.json by the case's name; None where the diagnosis failed.
        rivals: content of rivals.json by the case's name: what each rival said.
        seconds: that the diagnosis took, by the case's name.

    Returns:
        `targets`, what is to be reached beside what was, and what the rivals reached; `strata`, per kind and lambda: number
        of cases, verdicts, rates with intervals, size of the class, closed fraction and width of its interval, seconds,
        and `rivals`, of which each has the same as far as it says it; `cases`, what was said of each; `missing`, the cases
        without an answer.

    Raises:
        InputError: the key is none, no case has an answer, or one is of other data than the key's.
    """
    truths, track = check_key(key), str(key.get("track"))
    for name, report in reports.items():
        _check_report(name, truths.get(name, {}), report)
    answers = {
        name: Answer(track, truth, reports[name], seconds.get(name))
        for name, truth in truths.items()
        if name in reports
    }
    if not answers:
        raise InputError(
            "answers", "a report for cases of this key", "none", "Give the folder of the answers"
        )
    strata = {(a.kind, a.lambda_): [n for n in answers if _same(answers[n], a)] for a in answers.values()}
    theirs = rival_answers(answers, rivals)
    if theirs and any(name not in rivals for name in answers):
        theirs = {SAME: {name: answers[name] for name in answers if name in rivals}, **theirs}
    return {
        "format": "dtprob.score",
        "version": 2,
        "targets": against_targets(
            list(answers.values()), {rival: list(said.values()) for rival, said in theirs.items()}
        ),
        "strata": [
            {
                "kind": kind,
                "lambda": size,
                **_judged([answers[name] for name in names]),
                "rivals": {
                    rival: _judged([said[name] for name in names if name in said])
                    for rival, said in theirs.items()
                    if any(name in said for name in names)
                },
            }
            for (kind, size), names in sorted(strata.items())
        ],
        "cases": [_line(name, answer) for name, answer in answers.items()],
        "missing": [name for name in truths if name not in reports],
    }


def check_key(key: Mapping[str, Any]) -> dict[str, Truth]:
    """The record of each case by its name.

    Args:
        key: content of key.json.

    Raises:
        InputError: a record that lacks something, or two of one name.
    """
    truths: dict[str, Truth] = {}
    try:
        for case in key["cases"]:
            name, kind = str(case["name"]), str(case["kind"])
            if kind not in _KINDS:
                raise unknown_name(f"kind of case {name} in the key", kind, _KINDS, "kind")
            if name in truths:
                raise InputError("key", "one record of each case", f"two of {name}", "Leave one of them out")
            if not all(isinstance(effect["name"], str) for effect in case["effects"]):
                raise InputError(f"effects of case {name} in the key", "names", "others", "Correct them")
            if (kind == "null") == bool(case["effects"]):
                expected = "no effects" if kind == "null" else "its effects"
                raise InputError(
                    f"case {name} in the key, {kind}", expected, f"{len(case['effects'])}", "Correct it"
                )
            if kind != "null" and not isinstance(case["lambda"], int | float):
                got = repr(case["lambda"])
                raise InputError(f"lambda of case {name} in the key", "a number", got, "Correct it")
            truths[name] = case
    except (KeyError, TypeError) as error:
        expected = "`cases`, each with name, kind, lambda and effects"
        raise InputError("key", expected, f"none of {error}", "Give the key.json of these cases") from error
    return truths


def _check_report(name: str, truth: Truth, report: Report | None) -> None:
    """Answers of another study have the same names of cases: where both tell hashes of the data, these tell."""
    if report is None:
        return
    for part in ("verdict", "causes"):
        if part not in report:
            raise InputError(f"answer {name}", f"a report with its {part}", "none", "Answer the case again")
    made_of = report.get("provenance", {}).get("data_sha256")
    known = truth.get("sha256")
    if made_of and known and made_of not in known.values():
        remedy = "Give the key of the cases that these are answers to"
        raise InputError(
            f"answer {name}", "one to the case that the key describes", "one of other data", remedy
        )


def _same(one: Answer, other: Answer) -> bool:
    return (one.kind, one.lambda_) == (other.kind, other.lambda_)


def rival_answers(
    answers: Mapping[str, Answer], rivals: Mapping[str, Mapping[str, Report]]
) -> dict[str, dict[str, Answer]]:
    """The answers of each rival by the case's name.

    Args:
        answers: of the diagnosis, whose screening they share, by the case's name.
        rivals: content of rivals.json by the case's name: what each rival said.
    """
    found: dict[str, dict[str, Answer]] = {}
    for name, said in rivals.items():
        for rival, report in said.items():
            own = answers[name]
            seen = {part: own.report[part] for part in _SHARED if own.report and part in own.report}
            seconds = report.get("seconds")
            found.setdefault(rival, {})[name] = Answer(own.track, own.truth, {**seen, **report}, seconds)
    return found


def _judged(answers: Sequence[Answer]) -> dict[str, Any]:
    """One method's row of one stratum."""
    group = "listed" if answers[0].kind in _LISTED_KINDS else answers[0].kind
    verdicts = sorted({answer.verdict for answer in answers})
    result: dict[str, Any] = {
        "cases": len(answers),
        "verdicts": {verdict: sum(a.verdict == verdict for a in answers) for verdict in verdicts},
        "rates": rates(_MEASURES.get(group, _MEASURES["null"]), answers),
        "seconds": quantiles([a.seconds for a in answers if a.seconds is not None]),
    }
    if group == "listed":
        right = [a.first["closed_fraction"] for a in answers if a.is_right and a.first]
        closed = [fraction for fraction in right if fraction]
        result["closed_fraction"] = quantiles([fraction["mean"] for fraction in closed])
        result["closed_fraction_width"] = quantiles([f["high"] - f["low"] for f in closed])
        result["class_size"] = quantiles([len(a.alias_class) for a in answers if a.first])
    return result


def _line(name: str, answer: Answer) -> dict[str, Any]:
    return {
        "name": name,
        "kind": answer.kind,
        "lambda": answer.truth.get("lambda"),
        "true": sorted(answer.effects),
        "verdict": answer.verdict,
        "named": sorted(answer.named),
        "probability": answer.first["probability"] if answer.first else None,
        "right": answer.is_right if answer.kind in _LISTED_KINDS else None,
        "best_possible": answer.limit.named if answer.limit else None,
        "unexplained": answer.unexplained if answer.kind == "unlisted" else None,
        "seconds": answer.seconds,
    }
