"""The test of one site family: are its scores larger than replicates of the data say?"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from dtprob.gap.tails import variance_ratio_tail
from dtprob.gap.where.families import Family

CHANCE: Final = 8
"""Replicates that tell what a site would gain by chance."""
_ALONE: Final = 1 - 1e-9
"""Share of an entry's variance above which one replicate is all there is of it: rare outcomes move no other."""


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


def family_test(family: Family, scores: np.ndarray) -> FamilyTest:
    """Test a family's summed squared scores (1 + replicate, entry), each entry scaled by its null variance."""
    first, n = scores[: 1 + CHANCE].copy(), len(scores) - 1
    share = scores[1:] ** 2
    total = share.sum(0)
    variance = total / n
    alive = total > 1e-12 * max(float(total.max(initial=0.0)), 1e-300)
    if not alive.any():
        return FamilyTest(family, 1.0, np.ones(n), first, variance)
    given = scores[0]
    if not alive.all():
        share, given, total = share[:, alive], given[alive], total[alive]
    share /= total
    share[share > _ALONE] = 0.0
    statistic = (n - 1) * (share / (1.0 - share)).sum(1)  # each replicate scaled by the others
    value = float((given**2 / (total / n)).sum())
    p = variance_ratio_tail(
        np.append(statistic, value), float(statistic.mean()), float(statistic.var()), n - 1
    )
    return FamilyTest(family, float(p[-1]), p[:-1], first, variance)
