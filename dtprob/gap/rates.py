"""Shares of cases with exact intervals, and quantiles."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import stats

LEVEL: Final = 0.95


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


def rates[T](
    tests: Mapping[str, Callable[[T], Iterable[bool]]], subjects: Sequence[T]
) -> dict[str, dict[str, Any]]:
    """The share that passes each test; tests that nothing undergoes are left out.

    Args:
        tests: name -> (subject -> one outcome for each thing that is judged, none where the test does not apply).
        subjects: what is tested.
    """
    found = {}
    for name, test in tests.items():
        outcomes = [outcome for subject in subjects for outcome in test(subject)]
        if outcomes:
            found[name] = Rate(sum(outcomes), len(outcomes)).to_dict()
    return found


def quantiles(values: Sequence[float]) -> dict[str, float] | None:
    """Lowest decile, median and highest decile; None of nothing."""
    if not values:
        return None
    low, median, high = np.quantile(np.asarray(values, float), [0.1, 0.5, 0.9])
    return {"lowest_decile": float(low), "median": float(median), "highest_decile": float(high)}
