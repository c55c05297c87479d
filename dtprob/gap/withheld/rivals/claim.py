"""What a rival says about a case."""

from __future__ import annotations

from typing import Any, NamedTuple

_RANKED = 10
"""Candidates that are written down in order."""


class Claim(NamedTuple):
    """A rival's answer.

    Attributes:
        p_value: of there being no gap, by the rival's own statistic, calibrated on data drawn at the base fit.
        effects: the set that it names.
        ranking: all candidates, the best first.
        unlisted: whether it says that none of the candidates is the cause.
    """

    p_value: float
    effects: tuple[str, ...]
    ranking: tuple[str, ...]
    unlisted: bool = False

    def to_report(self, level: float) -> dict[str, Any]:
        """The answer in the form of report.json: verdict and causes; nothing is named without an alarm.

        Args:
            level: probability of an alarm without a gap.
        """
        if self.p_value > level:
            verdict, effects = "NO_GAP", ()
        elif self.unlisted:
            verdict, effects = "UNLISTED", ()
        else:
            verdict, effects = ("LISTED" if self.effects else "UNDETERMINED"), self.effects
        named = list(effects)
        cause = {"effects": named, "alias_class": [named], "probability": None, "closed_fraction": None}
        return {
            "verdict": verdict,
            "causes": [cause] if named else [],
            "p_value": self.p_value,
            "ranking": list(self.ranking[:_RANKED]),
        }
