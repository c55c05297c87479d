"""Settings of a diagnosis, with the defaults that the documented error rates were measured with."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Final

from dtprob.errors import InputError

_LEAST: Final = {
    "replicates": 20,
    "site_replicates": 10,
    "site_times": 1,
    "candidates": 1,
    "polished": 0,
    "max_effects": 1,
    "folds": 2,
    "grid": 2,
    "starts": 1,
}
"""Of whole numbers."""


@dataclass(frozen=True)
class Settings:
    """How a diagnosis is run.

    Attributes:
        level: false-alarm probability of a whole diagnosis, shared by the effects and the site tests.
        replicates: bootstrap replicates of the score statistics.
        site_replicates: bootstrap replicates of the site tests; each costs about one gradient.
        site_times: where a site test comes near its level, up to this many times more replicates decide.
        candidates: how many effects are refitted in full at each step of the search; what a scan finds best is besides.
        polished: how many of these, and of the fits of the base model, are also freed from local optima of the nuisances;
            beside effects that are fitted at most one.
        max_effects: the largest set of effects that is looked for.
        folds: parts of the clusters for cross-fitted held-out losses.
        grid: trial sizes per effect parameter when a refit looks for its starting points.
        starts: starting points of a refit.
        credibility: probability that a reported class of causes must hold.
        relevance: share of the gap that causes must close to count as its explanation where something is left.
        field_relevance: the same of random fields alone, which can imitate nearly anything.
        minor: a further effect must add this share of the evidence that the effects before it have brought.
        remainder: whether what is left is modelled at its site, which takes long where sites have many entries.
        tolerance_db: residual error that the user does not care about, in dB below the signal; of powers, their root mean
            square error in dB, and of other readings, such as levels in dBm, that in their own unit. None for no tolerance.

    Raises:
        InputError: a number out of its range.
    """

    level: float = 0.01
    replicates: int = 400
    site_replicates: int = 99
    site_times: int = 20
    candidates: int = 8
    polished: int = 3
    max_effects: int = 3
    folds: int = 4
    grid: int = 32
    starts: int = 2
    credibility: float = 0.9
    relevance: float = 0.75
    field_relevance: float = 0.9
    minor: float = 0.03
    remainder: bool = True
    tolerance_db: float | None = None

    def __post_init__(self) -> None:
        for setting in fields(self):
            self._check(setting.name, getattr(self, setting.name))

    def _check(self, name: str, value: Any) -> None:
        if name in _LEAST:
            is_number = isinstance(value, int) and not isinstance(value, bool)
            is_right, expected = (
                is_number and value >= _LEAST[name],
                f"a whole number from {_LEAST[name]}",
            )
        elif name == "remainder":
            is_right, expected = isinstance(value, bool), "true or false"
        elif name == "tolerance_db":
            is_right, expected = (
                value is None or _is_within(value, 0.0, float("inf")),
                "a positive number, or none",
            )
        elif name == "level":
            is_right, expected = _is_within(value, 0.0, 1.0), "a probability between 0 and 1"
        else:
            is_right, expected = value in (0, 1) or _is_within(value, 0.0, 1.0), "a share from 0 to 1"
        if not is_right:
            raise InputError(f"settings of a diagnosis: {name}", expected, repr(value), "Correct the setting")


def _is_within(value: Any, low: float, high: float) -> bool:
    """Whether it is a number between two others, these left out."""
    return isinstance(value, int | float) and not isinstance(value, bool) and low < value < high
