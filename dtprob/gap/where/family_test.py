"""The test of one site family: are its scores larger than replicates of the data say?"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dtprob.gap.tails import largest_tail, moments_of_others, variance_ratio_tail
from dtprob.gap.where.families import Family

CHANCE: Final = 8
"""Replicates that tell what a site would gain by chance."""
_SEVERAL: Final = 8
"""Entries from which on the largest is looked at beside the sum."""
_HEAVIEST: Final = 6.0
"""Kurtosis of a score over replicates up to which the largest of several tells something; 3 of a normal one."""
_MOSTLY: Final = 0.9
"""Share of the entries that have to be no heavier."""
_NORMAL: Final = 3.6
_WEIGHED: Final = 3.0
"""Kurtosis from which on an entry's square counts less, since its tails reach farther, and by which power of its excess."""
_ALONE: Final = 0.5
"""Share of an entry's squares that the other replicates have at least where one is judged by its kurtosis in these. The
data count for no more than a replicate can."""
_OTHERS: Final = 1e-9
"""Share of an entry's variance below which the other replicates tell nothing of it: rare outcomes move but one."""
_SEEN: Final = 0.25
"""Share of an entry's variance that replicates have at least if they see its outcomes at all."""
_RARE: Final = 9.0
"""Squared score over its variance that an entry of outcomes or counts may bring that moves in few replicates."""
_AT_ONCE: Final = 1 << 17
"""Scores that are looked at together, so that they stay in the processor's cache."""


class FamilyTest(NamedTuple):
    """A site family's test.

    Attributes:
        family: what was tested.
        p_value: of the data.
        null: p-value of each replicate.
        first: scores (1 + CHANCE, entry) of the data and of the first replicates.
        variance: of the scores, (entry,).
    """

    family: Family
    p_value: float
    null: np.ndarray
    first: np.ndarray
    variance: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """Which entries (entry,) the data depend on."""
        return self.variance > 1e-12 * max(float(self.variance.max(initial=0.0)), 1e-300)

    @property
    def told(self) -> np.ndarray:
        """The data's squared scores over their variance, (entry,); 0 where the data do not depend on an entry."""
        seen = self.seen
        return np.where(seen, self.first[0] ** 2 / np.where(seen, self.variance, 1.0), 0.0)

    @property
    def pattern(self) -> str:
        """How the family varies, in words; of curves that overlap, the place that tells most."""
        return self.family.pattern.label if (place := self._place) is None else place

    @property
    def whereabouts(self) -> str | None:
        """The same, where it says where or along what."""
        curves = self.family.pattern.curves
        return self._place or (
            self.family.pattern.label if curves is not None and curves.says_where else None
        )

    @property
    def _place(self) -> str | None:
        """Of curves that overlap, the place that tells most."""
        curves = self.family.pattern.curves
        if curves is None or not curves.overlaps or not self.seen.any():
            return None
        told = self.told
        return curves.places[int(told.argmax()) // (len(told) // len(curves.places))]


def family_test(family: Family, scores: np.ndarray, normal: np.ndarray | None = None) -> FamilyTest:
    """Test a family's squared scores (1 + replicate, entry), each entry scaled by its null variance.

    Their sum notices what is wrong everywhere, their largest what is wrong at a few entries of many; the p-value is the
    smaller one's, of the data and of the replicates alike.

    Args:
        family: what is tested.
        scores: of the data and of replicates.
        normal: scores (draw, entry) of the same covariance but normal, of outcomes and counts. Entries that live on
            ones so rare that the replicates do not have them are left out, what moves in few replicates counts little.
    """
    first, n = scores[: 1 + CHANCE].copy(), len(scores) - 1
    total = np.einsum("ne,ne->e", scores[1:], scores[1:])
    alive = total > 1e-12 * max(float(total.max(initial=0.0)), 1e-300)
    if normal is not None:
        alive &= total / n > _SEEN * (normal**2).mean(axis=0)
    if not alive.any():
        return FamilyTest(family, 1.0, np.ones(n), first, total / n)
    most = np.inf if normal is None else _RARE
    summed, largest, steady, weight = _against_the_others(scores[1:], np.where(alive, total, np.inf), most)
    statistic, own = (n - 1) * summed, scores[0, alive] ** 2 / total[alive]
    counted = np.where(steady[alive], own, np.minimum(own, most / n))
    sums = np.append(statistic, n * counted.sum())
    others = moments_of_others(sums)
    p = variance_ratio_tail(sums, others.mean, others.variance, n - 1)
    if steady.sum() >= max(_SEVERAL, _MOSTLY * alive.sum()):
        weighed = np.minimum(own[steady[alive]], 1 / _ALONE - 1) * weight[steady]
        p = np.minimum(p, largest_tail(np.append((n - 1) * largest, n * weighed.max())))
    return FamilyTest(family, float(p[-1]), p[:-1], first, total / n)


class _Null(NamedTuple):
    """What replicates make of a family.

    Attributes:
        summed: each replicate's squared scores, over the sum of the others', summed over the entries.
        largest: the largest of them, weighed.
        steady: entries that do not move in few replicates only, (entry,).
        weight: of an entry's square among the largest, (entry,).
    """

    summed: Float[np.ndarray, " replicate"]
    largest: Float[np.ndarray, " replicate"]
    steady: Bool[np.ndarray, " entry"]
    weight: Float[np.ndarray, " entry"]


def _against_the_others(
    scores: Float[np.ndarray, "replicate entry"], total: Float[np.ndarray, " entry"], most: float
) -> _Null:
    """Each replicate beside the others as the data are beside all, a few entries at a time.

    Which entries count among the largest of a replicate, and how much, the others say: were it judged by a kurtosis that it
    is part of, no replicate could be as far out as the data can.

    Args:
        scores: of the replicates.
        total: sum of their squares, infinite where an entry does not count.
        most: of a squared score over its variance that the sum takes from an entry that is not steady.
    """
    n = len(scores)
    found = _Null(np.zeros(n), np.zeros(n), np.zeros(len(total), bool), np.ones(len(total)))
    every, width = np.arange(n), max(_AT_ONCE // n, 1)
    for start in range(0, len(total), width):
        at = slice(start, min(start + width, len(total)))
        part = _Part.of(scores[:, at] ** 2, total[at])
        counts = total[at] < np.inf
        kurtosis = n * part.fourth / np.where(counts, part.total, 1.0) ** 2
        found.steady[at] = (kurtosis < _HEAVIEST) & counts
        found.weight[at] = _weight(kurtosis)
        ratio = part.own / part.others
        capped = np.minimum(ratio, np.where(found.steady[at], np.inf, most / (n - 1)))
        np.add(found.summed, capped.sum(1), out=found.summed)
        # weights are at most 1: beside each replicate's largest ratio, few others can weigh more
        np.maximum(found.largest, part.weighed(every, ratio.argmax(1)), out=found.largest)
        larger = np.divmod(np.flatnonzero(ratio > found.largest[:, None]), ratio.shape[1])
        np.maximum.at(found.largest, larger[0], part.weighed(*larger))
    return found


class _Part(NamedTuple):
    """Squared scores (replicate, entry) of a few entries.

    Attributes:
        own: of each replicate; 0 where the others tell nothing of the entry.
        others: sum over the other replicates; 1 where they tell nothing.
        fourth: sum of the squares of `own` over replicates, (entry,), before any was set to 0.
        total: sum over replicates, infinite where an entry does not count, (entry,).
    """

    own: Float[np.ndarray, "replicate entry"]
    others: Float[np.ndarray, "replicate entry"]
    fourth: Float[np.ndarray, " entry"]
    total: Float[np.ndarray, " entry"]

    @classmethod
    def of(cls, own: np.ndarray, total: np.ndarray) -> _Part:
        """From all squares; sets those to 0 that are alone."""
        fourth, others = np.einsum("ne,ne->e", own, own), total - own
        lone = np.flatnonzero(others.min(0) < _OTHERS * total)
        if len(lone):
            alone = others[:, lone] < _OTHERS * total[lone]
            own[:, lone], others[:, lone] = (
                np.where(alone, 0.0, own[:, lone]),
                np.where(alone, 1.0, others[:, lone]),
            )
        return cls(own, others, fourth, total)

    def weighed(self, replicate: np.ndarray, entry: np.ndarray) -> np.ndarray:
        """Ratios of own squares to the others', weighed by the kurtosis in these; 0 where they are no judges."""
        own, others = self.own[replicate, entry], self.others[replicate, entry]
        total, n = self.total[entry], len(self.own)
        counts = total < np.inf
        beside = (n - 1) * (self.fourth[entry] - own**2) / np.where(counts, others, 1.0) ** 2
        judged = (beside < _HEAVIEST) & (others > _ALONE * total) & counts
        return np.where(judged, own / others * _weight(beside), 0.0)


def _weight(kurtosis: np.ndarray) -> np.ndarray:
    """Of a square among the largest, by the entry's kurtosis."""
    return (_NORMAL / np.maximum(kurtosis, _NORMAL)) ** _WEIGHED
