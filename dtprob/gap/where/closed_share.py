"""How what the causes close is spread over the data's coordinates, beside how it should be.

To first order a position j gains <delta, r>_j - <delta, delta>_j / 2 nats, <delta, delta>_j / 2 on average with a standard
deviation of |delta_j|; see `reach`. A cause that stands in for another one closes the gap where it should not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from dtprob.gap.where.reach import Told


@dataclass(frozen=True)
class ClosedShare:
    """Shares of what the causes close, along one axis.

    Attributes:
        found: share (position,) that each position gains; they sum to 1.
        expected: what it gains on average if the causes are as they are fitted.
        total: nats that all positions gain.
    """

    found: Float[np.ndarray, " position"]
    expected: Float[np.ndarray, " position"]
    total: float


def closed_shares(along: Mapping[str, Told]) -> dict[str, ClosedShare]:
    """Shares along every axis of several positions; none where nothing is gained in sum.

    Args:
        along: what each position tells of the causes, by axis.
    """
    shares = {}
    for axis, here in along.items():
        if len(here.gain) > 1 and (total := float(here.gain.sum())) > 0:
            shares[axis] = ClosedShare(here.gain / total, here.energy / 2 / total, total)
    return shares
