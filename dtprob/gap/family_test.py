"""The test of one site family: are its scores larger than replicates of the data say?"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from dtprob.gap.families import Family
from dtprob.gap.tails import variance_ratio_tail

CHANCE: Final = 8
"""Replicates that tell what a site would gain by chance."""


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
    given, null = scores[0], scores[1:]
    total = (null**2).sum(0)
    variance = total / n
    alive = total > 1e-12 * max(float(total.max(initial=0.0)), 1e-300)
    if not alive.any():
        return FamilyTest(family, 1.0, np.ones(n), first, variance)
    null, given, total = null[:, alive], given[alive], total[alive]
    left_out = (total - null**2) / (n - 1)
    known = left_out > 1e-9 * total / n  # rare outcomes move an entry in one replicate and in no other
    statistic = (np.where(known, null**2, 0.0) / np.where(known, left_out, 1.0)).sum(1)
    value = float((given**2 / (total / n)).sum())
    p = variance_ratio_tail(
        np.append(statistic, value), float(statistic.mean()), float(statistic.var()), n - 1
    )
    return FamilyTest(family, float(p[-1]), p[:-1], first, variance)
