"""P-values of many families of sites together, half the chance of an error kept for the few that are what most causes do.

Among thousands of ways to be wrong, one that most causes take would need a p-value of 1e-6 to count. With weights given
beforehand (Genovese, Roeder and Wasserman, Biometrika 93 (2006) 509) it needs 1e-4. Half of the whole level is kept back,
since p-values so small are extrapolated: replicates tell the middle of their law.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple, Self

import numpy as np

from dtprob.gap.tails import any_of, effective_tests
from dtprob.gap.where.family_test import FamilyTest

_GROUPS: Final = (True, False)
"""What is simple, and what is not."""
_KEPT_BACK: Final = 2.0
"""Times that a p-value has to be smaller than the replicates say."""


class InAll(NamedTuple):
    """How many independent tests there are of each kind.

    Attributes:
        tests: by whether they are of simple families; without those kinds of which there are none.
    """

    tests: dict[bool, float]

    @classmethod
    def of(cls, every: Sequence[FamilyTest]) -> Self:
        """From all tests, as their replicates show."""
        nulls = {g: [t.null for t in every if t.family.is_simple == g] for g in _GROUPS}
        return cls({g: effective_tests(np.min(null, axis=0)) for g, null in nulls.items() if null})

    def p_value(self, test: FamilyTest) -> float:
        """Family-wise over all tests."""
        own = any_of(np.array(test.p_value), self.tests[test.family.is_simple])
        return float(any_of(own, _KEPT_BACK * len(self.tests)))
