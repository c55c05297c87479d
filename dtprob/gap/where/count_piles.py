"""Counts that are seen more often than those next to them and than the fitted twin let them be.

Zeros of reports that were lost, a counter at its end, a default: these stand out from their neighbours. A law that is wrong
elsewhere, spread more than the twin knows, makes rare counts frequent too, but their neighbours as well.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from scipy import stats

_BESIDE: Final = 2
"""Counts on each side that tell how often one is."""
FEWEST: Final = 5
"""Times that a value is seen from which on it is looked at."""
TIMES: Final = 1.5
"""Times what is expected that it is seen at least."""
MOST: Final = 4096
"""Counts from the smallest to the largest that are looked at, at most."""


def count_piles(
    seen: Float[np.ndarray, " count"], expected: Float[np.ndarray, " count"]
) -> Float[np.ndarray, " count"]:
    """The chance of each count of a range to be seen so often.

    A count is expected as often as those next to it are seen; as the twin says, times as often as its neighbours are seen
    more than it says; and as a series that goes on from the two before or after it would have it.

    Args:
        seen: how often each is seen.
        expected: how often the fitted twin sees it.
    """
    beside = [by for by in range(-_BESIDE, _BESIDE + 1) if by]
    seen_at = {by: _shifted(seen, by) for by in beside}
    more = [(seen_at[by] + 1) / (_shifted(expected, by) + 1) for by in beside]
    series = [seen_at[by] ** 2 / np.maximum(seen_at[2 * by], 1.0) for by in (-1, 1)]
    by_twin = expected * np.maximum(np.max(more, axis=0), 1.0)
    least = np.max([np.ones(len(seen)), by_twin, seen_at[-1], seen_at[1], *series], axis=0)
    tail = stats.poisson.sf(seen - 1, least)
    return np.where((seen >= FEWEST) & (seen >= TIMES * least), tail, 1.0)


def _shifted(values: np.ndarray, by: int) -> np.ndarray:
    """What stands so many places before, zero beyond the ends."""
    padded = np.pad(values, _BESIDE)
    return padded[_BESIDE - by : len(values) + _BESIDE - by]
