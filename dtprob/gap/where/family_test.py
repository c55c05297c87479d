"""The test of one site family: are its scores larger than replicates of the data say?"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dtprob.gap.tails import largest_tail, variance_ratio_tail
from dtprob.gap.where.families import Family

CHANCE: Final = 8
"""Replicates that tell what a site would gain by chance."""
_SEVERAL: Final = 8
"""Entries from which on the largest is looked at beside the sum."""
_HEAVIEST: Final = 6.0
"""Kurtosis of a score over replicates up to which the largest of several tells something; 3 of a normal one."""
_MOSTLY: Final = 0.9
"""Share of the entries that have to be no heavier."""
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
    summed, largest, steady = _against_the_others(scores[1:], np.where(alive, total, np.inf), most)
    statistic, own = (n - 1) * summed, scores[0, alive] ** 2 / total[alive]
    counted = np.where(steady[alive], own, np.minimum(own, most / n))
    p = variance_ratio_tail(
        np.append(statistic, n * counted.sum()), float(statistic.mean()), float(statistic.var()), n - 1
    )
    if steady.sum() >= max(_SEVERAL, _MOSTLY * alive.sum()):
        p = np.minimum(p, largest_tail(np.append((n - 1) * largest, n * own[steady[alive]].max())))
    return FamilyTest(family, float(p[-1]), p[:-1], first, total / n)


def _against_the_others(
    scores: Float[np.ndarray, "replicate entry"], total: Float[np.ndarray, " entry"], most: float
) -> tuple[Float[np.ndarray, " replicate"], Float[np.ndarray, " replicate"], Bool[np.ndarray, " entry"]]:
    """Each replicate's squared scores over the sum of the others', a few entries at a time: their sum, and the largest.

    The largest is that of the steady entries, which are returned, too: others move in few replicates only.

    Args:
        scores: of the replicates.
        total: sum of their squares, infinite where an entry does not count.
        most: of a squared score over its variance that the sum takes from an entry that is not steady.
    """
    summed, largest = np.zeros((2, len(scores)))
    steady = np.zeros(len(total), bool)
    width = max(_AT_ONCE // len(scores), 1)
    for start in range(0, len(total), width):
        own = scores[:, start : start + width] ** 2
        others = total[start : start + width] - own
        alone = others < _OTHERS * total[start : start + width]
        if alone.any():
            own[alone], others[alone] = 0.0, 1.0
        part = slice(start, start + own.shape[1])
        steady[part] = (_HEAVIEST * total[part] ** 2 > len(scores) * (own**2).sum(0)) & (total[part] < np.inf)
        ratio = own / others
        counted = np.where(steady[part], ratio, np.minimum(ratio, most / (len(scores) - 1)))
        summed += (counted if most < np.inf else ratio).sum(1)
        np.maximum(largest, np.max(ratio, axis=1, where=steady[part], initial=0.0), out=largest)
    return summed, largest, steady
