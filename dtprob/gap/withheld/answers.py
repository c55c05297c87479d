"""What was said about a withheld case, beside what is true of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from dtprob.gap.settings import Settings
from dtprob.gap.withheld.limits import Limit, correlation_matrix, is_resolvable, limit
from dtprob.gap.withheld.truths import INSTANCES_UNTOLD, PARAMETERS, SITES

type Report = Mapping[str, Any]
type Truth = Mapping[str, Any]

_HAS_CAUSE: Final = ("LISTED", "LISTED_WITH_REMAINDER")


@dataclass(frozen=True)
class Answer:
    """What was said about one case, beside what is true.

    Attributes:
        track: of the case; of no meaning for keys that do not name a track.
        truth: its record in the key.
        report: the content of its report.json, or what a rival said; None where that failed.
        seconds: that it took, where known.
    """

    track: str
    truth: Truth
    report: Report | None
    seconds: float | None

    @property
    def kind(self) -> str:
        """Of case."""
        return str(self.truth["kind"])

    @property
    def lambda_(self) -> float:
        """Information that each effect carries alone; 0 where there is none."""
        return 0.0 if self.kind == "null" else float(self.truth.get("lambda") or 0.0)

    def lambda_of(self, effect: Mapping[str, Any]) -> float:
        """Information that a true effect carries, or that the key promises for each where it does not tell."""
        own = effect.get("lambda")
        return self.lambda_ if own is None else float(own)

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
        """The effects of the most probable cause, each in the words of the key."""
        return self._told(self.first["effects"]) if self.first else frozenset()

    @property
    def alias_class(self) -> list[frozenset[str]]:
        """All sets of effects that the answer holds possible."""
        return [self._told(item) for item in self.first["alias_class"]] if self.first else []

    def _told(self, names: Iterable[str]) -> frozenset[str]:
        """Names with the family in place of an instance that the key does not tell."""
        untold = self.effects & INSTANCES_UNTOLD.get(self.track, frozenset())
        return frozenset(_family(name) if _family(name) in untold else name for name in names)

    @property
    def is_alarm(self) -> bool:
        """Whether a gap is claimed."""
        return self.verdict != "NO_GAP" and not self.is_failed

    @property
    def is_failed(self) -> bool:
        """Whether there is no answer."""
        return self.report is None

    def alarms(self) -> list[bool]:
        """Whether a gap is claimed; nothing where there is no answer, which is no silence either."""
        return [] if self.is_failed else [self.is_alarm]

    def calls_unlisted(self) -> list[bool]:
        """Whether the cause is said to be unlisted; nothing where there is no answer."""
        return [] if self.is_failed else [self.is_unlisted]

    @property
    def is_missed(self) -> bool:
        """Whether no gap is claimed."""
        return self.verdict == "NO_GAP"

    @property
    def is_right(self) -> bool:
        """Whether the most probable cause is exactly the true set of effects, and the verdict does not say none is."""
        return self.named == self.effects and not self.is_unlisted

    @property
    def is_right_family(self) -> bool:
        """Whether the families are right, whatever the instance, such as the wall or the antenna."""
        return _families(self.named) == _families(self.effects)

    @property
    def is_in_class(self) -> bool:
        """Whether the true set is among those that the answer holds possible."""
        return self.is_right or (self.effects in self.alias_class and not self.is_unlisted)

    @property
    def is_listed(self) -> bool:
        """Whether a known cause is named."""
        return self.verdict in _HAS_CAUSE

    @property
    def is_unlisted(self) -> bool:
        """Whether the verdict says that the cause is not among the candidates."""
        return self.verdict == "UNLISTED"

    def wrong_names(self) -> list[tuple[float, float]]:
        """How many of the named effects are none of the true ones, and how many are named; nothing where none is."""
        return [(float(len(self.named - self.effects)), float(len(self.named)))] if self.named else []

    def names_wrong(self) -> list[bool]:
        """Whether one of the named effects is none of the true ones; nothing where none is named."""
        return [bool(self.named - self.effects)] if self.named else []

    def names_alias(self) -> list[bool]:
        """Whether the effect that looks like the true one is in the class, too."""
        alias = self.truth.get("alias")
        return [frozenset([alias["name"]]) in self.alias_class] if alias else []

    def right_site(self) -> list[bool]:
        """Whether the first of the sites that the answer points at is one at which the true effects show."""
        known = SITES.get(self.track, {})
        true = {site for e in self.truth["effects"] for site in known.get(str(e.get("family")), ())}
        if not true or (self.report is not None and "where" not in self.report):
            return []
        if self.report is None:
            return [False]
        located = self.report["where"]["sites"]
        places = [*self.report["unlisted"]["sites"], *(s["site"] for s in located)]
        if not self.is_alarm or not places:
            return [False]
        if f"spread of {places[0]}" in true:
            families = [s.get("family", "") for s in located if s["site"] == places[0]]
            return [any(family.startswith("spread") for family in families)]
        return [places[0] in true]

    def covered_size(self) -> list[bool]:
        """Whether the 90% interval of the size holds the true one, where one right effect has a comparable size."""
        sizes = list(self.first.get("size", {}).values()) if self.first else []
        if not self.is_right or len(self.truth["effects"]) != 1 or not sizes:
            return []
        effect = self.truth["effects"][0]
        values = PARAMETERS.get(self.track, {}).get(str(effect.get("family")))
        if values is None:
            return []
        return [any(sizes[0]["low"] <= v <= sizes[0]["high"] for v in values(float(effect["size"])))]

    def covered_fraction(self) -> list[bool]:
        """Whether the 90% interval of the closed fraction holds what a right answer can expect to close.

        That is 1 - d / lambda for d parameters that are known from (K - 1) / K of the data, lambda of all effects together.
        """
        closed = self.first.get("closed_fraction") if self.first else None
        total = sum(map(self.lambda_of, self.truth["effects"]))
        if not (self.is_right and closed and total > 0 and self.first):
            return []
        folds, size = Settings().folds, float(self.first.get("parameters", len(self.first.get("size", {}))))
        return [closed["low"] <= 1 - size * folds / (folds - 1) / total <= closed["high"]]

    @cached_property
    def limit(self) -> Limit | None:
        """What the best possible diagnosis reaches; None where there is not one effect, or the report cannot tell."""
        effects, alike = self.truth["effects"], self._alike
        if alike is None or len(effects) != 1 or not (places := self._candidates(effects[0])):
            return None
        seen = {
            line["effect"]: abs(float(line["z"] or 0.0)) for line in (self.report or {}).get("screening", [])
        }
        best = max(places, key=lambda place: seen.get(alike[0][place], 0.0))
        return limit(alike[1], best, self.lambda_of(effects[0]))

    def _candidates(self, effect: Mapping[str, Any]) -> list[int]:
        """Positions of a true effect among the candidates: all of its family where the key tells no instance."""
        names, true = [] if self._alike is None else self._alike[0], str(effect["name"])
        return [place for place, name in enumerate(names) if self._told([name]) == {true}]

    @property
    def _alike(self) -> tuple[list[str], np.ndarray] | None:
        """The candidates of the report, and the correlations of their scores."""
        alike = (self.report or {}).get("provenance", {}).get("alike")
        return None if alike is None else (alike["effects"], correlation_matrix(alike["percent"]))

    @property
    def is_resolvable(self) -> bool:
        """Whether each true effect can be told from every other candidate beside the others, as far as the report tells."""
        places = [(self._candidates(effect), self.lambda_of(effect)) for effect in self.truth["effects"]]
        if self._alike is None or not all(found for found, _ in places):
            return False
        correlation = self._alike[1]
        known = {found[0]: lambda_ for found, lambda_ in places}
        return all(
            is_resolvable(correlation, own, lambda_, [k for k in known if k != own])
            for own, lambda_ in known.items()
        )

    @property
    def unexplained(self) -> float:
        """Lambda that the candidates leave, lambda (1 - R^2): they explain what the best score of a single one does."""
        screening = (self.report or {}).get("screening") or []
        best = max((float(line["z"] or 0.0) ** 2 for line in screening), default=0.0)
        return max(self.lambda_ - max(best - 1, 0.0), 0.0)

    def over_limit(self, of: Callable[[Limit], float]) -> list[tuple[float, float]]:
        """Whether the right effect is first, and what the best possible diagnosis reaches."""
        return [] if self.limit is None else [(float(self.is_right), of(self.limit))]

    def screened_over_limit(self) -> list[tuple[float, float]]:
        """Whether the right effect has the first place of the screening, and the chance of the best possible one."""
        if self.limit is None or self.report is None or "where" not in self.report:
            return []
        first = self._told([self.report["screening"][0]["effect"]])
        return [(float(first == self.effects), self.limit.first)]

    def class_over_limit(self) -> list[tuple[float, float]]:
        """Size of the class of a single effect, and that of the best possible one."""
        if self.limit is None or len(self.named) != 1:
            return []
        return [(float(len(self.alias_class)), self.limit.class_size)]

    def cell_scores(self) -> list[float]:
        """F1 of the cells inside the reported blocks, for each axis on which the truth is local."""
        if self.report is None:
            return [0.0 for _ in self.truth.get("cells", {})]
        if "where" not in self.report:
            return []
        blocks, scores = self.report["where"]["coordinates"], []
        for axis, cells in self.truth.get("cells", {}).items():
            said = {
                i
                for b in blocks
                if axis in b["axes"]
                for low, high in b.get("parts", [b["axes"][axis]])
                for i in range(low, high + 1)
            }
            scores.append(2 * len(said & set(cells)) / (len(said) + len(cells)))
        return scores

    def width(self) -> list[float]:
        """Of the closed fraction's interval, where a right answer has one."""
        closed = self.first.get("closed_fraction") if self.first else None
        return [closed["high"] - closed["low"]] if closed and self.is_right else []

    def remainder_closed(self) -> list[float]:
        """Share that a model of the remainder closes on clusters left out; 0 where something is left and none was found."""
        if self.report is None or "remainder" not in self.report or not self.is_unlisted:
            return []
        remainder = self.report["remainder"]
        return [float(remainder["closed_fraction"]["mean"] or 0.0) if remainder else 0.0]

    @staticmethod
    def closes(share: float) -> Callable[[Answer], list[bool]]:
        """Whether a right answer with an established gap closes a share of it."""

        def test(answer: Answer) -> list[bool]:
            closed = answer.first.get("closed_fraction") if answer.first else None
            return [closed["mean"] >= share] if closed and answer.is_right else []

        return test


def _families(names: frozenset[str]) -> frozenset[str]:
    return frozenset(map(_family, names))


def _family(name: str) -> str:
    return name.split("[", maxsplit=1)[0]
