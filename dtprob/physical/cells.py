"""Which cells of the data an effect touches, along each axis, where it does not touch them all and they can be told."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

MOST: Final = 0.9
"""Share of the information that the touched cells hold."""
LOCAL: Final = 0.5
"""Share of an axis up to which an effect that holds so few cells counts as local on it."""
TOLD: Final = 16.0
"""Lambda of a stretch of cells, or of a cell where they have no order, from which on it can be told from chance."""


def touched(
    energy: Float[np.ndarray, "..."], axes: Sequence[str], lambda_: float, unordered: Collection[str] = ()
) -> dict[str, list[int]]:
    """The fewest positions of each axis that hold most of what effects tell.

    Args:
        energy: information of each cell up to a factor, never negative, in the data's shape.
        axes: a name for each dimension.
        lambda_: information of all cells.
        unordered: axes whose neighbours have nothing to do with each other.

    Returns:
        Sorted positions by axis. Left out are axes along which more than half of the positions are touched, and those whose
        stretches carry too little information to be told, on average.
    """
    found = {}
    for k, axis in enumerate(axes):
        along = energy.sum(axis=tuple(j for j in range(energy.ndim) if j != k))
        if along.sum() <= 0:
            continue
        order = np.argsort(-along, kind="stable")
        count = int(np.searchsorted(np.cumsum(along[order]), MOST * along.sum())) + 1
        cells = np.sort(order[:count])
        stretches = count if axis in unordered else 1 + int(np.sum(np.diff(cells) > 1))
        if count <= LOCAL * len(along) and MOST * lambda_ / stretches >= TOLD:
            found[axis] = [int(i) for i in cells]
    return found
