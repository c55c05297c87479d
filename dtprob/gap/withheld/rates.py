"""Shares of cases with exact intervals, and quantiles."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import stats

LEVEL: Final = 0.95
_DRAWS: Final = 2000
_FEWEST: Final = 6
"""Cases of which a bootstrap can tell an interval."""
_LEAST: Final = 1e-3
"""What the best possible diagnosis reaches at least: its simulation tells no less."""
_NO_INTERVAL: Final = {"low": None, "high": None}


@dataclass(frozen=True)
class Rate:
    """A share of cases with its two-sided 95% Clopper-Pearson interval.

    Attributes:
        count: how many; a fraction where they count as fewer than they are.
        of: among how many; at least 1.
    """

    count: float
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
            found[name] = rate(outcomes)
    return found


def rate(outcomes: Sequence[bool]) -> dict[str, Any]:
    """The share of some outcomes, at least one, that are true; see `Rate`."""
    return Rate(sum(outcomes), len(outcomes)).to_dict()


def most(outcomes: Sequence[bool]) -> dict[str, Any]:
    """The upper limit of the 95% interval of a share; it has no interval of its own."""
    return {"of": len(outcomes), "value": rate(outcomes)["high"], **_NO_INTERVAL}


def share_within(pairs: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Share of things that come in cases, from (how many are so, how many there are) of each case.

    What lies in one case need not be independent: the interval is the exact one of so large a share of the cases.
    """
    table = np.asarray(pairs, float)
    value = float(table[:, 0].sum() / table[:, 1].sum())
    low, high = Rate(value * len(table), len(table)).interval
    count, of = table.sum(axis=0).astype(int).tolist()
    return {"count": count, "of": of, "rate": value, "low": low, "high": high}


def median(values: Sequence[float]) -> dict[str, Any]:
    """Median of some values with its 95% interval, between two of the values in order (binomial); of few values none."""
    ordered = np.sort(np.asarray(values, float))
    n = len(ordered)
    found = {"of": n, "value": float(np.median(ordered))}
    below = int(stats.binom.ppf((1 - LEVEL) / 2, n, 0.5))
    if below == 0:
        return {**found, **_NO_INTERVAL}
    return {**found, "low": float(ordered[below - 1]), "high": float(ordered[n - below])}


def ratio(pairs: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Ratio of two sums over cases, with its 95% interval by the bootstrap over cases; of few or equal ones none."""
    table = np.asarray(pairs, float)
    found = {"of": len(table), "value": float(table[:, 0].sum() / table[:, 1].sum())}
    if len(table) < _FEWEST or np.ptp(table[:, 0] / table[:, 1]) == 0:
        return {**found, **_NO_INTERVAL}
    index = np.random.default_rng(0).integers(len(table), size=(_DRAWS, len(table)))
    drawn = table[index].sum(axis=1)
    low, high = np.quantile(drawn[:, 0] / drawn[:, 1], [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return {**found, "low": float(low), "high": float(high)}


def over_limit(pairs: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Share of successes over the mean of what could be reached, with the interval of the share, over that."""
    reachable = max(float(np.mean([possible for _, possible in pairs])), _LEAST)
    rate = Rate(int(sum(success for success, _ in pairs)), len(pairs))
    low, high = rate.interval
    found = {"of": rate.of, "value": rate.value / reachable, "low": low / reachable, "high": high / reachable}
    return {**found, "limit": reachable}


def quantiles(values: Sequence[float]) -> dict[str, float] | None:
    """Lowest decile, median and highest decile; None of nothing."""
    if not values:
        return None
    low, median, high = np.quantile(np.asarray(values, float), [0.1, 0.5, 0.9])
    return {"lowest_decile": float(low), "median": float(median), "highest_decile": float(high)}
