"""Which sets of effects the data cannot rule out, from what each is worth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

IDLE: Final = float(np.log(3.0))
"""Nats that an effect has to bring lest it is idle."""

type Names = tuple[str, ...]


def credible(
    worth: Mapping[Names, float], accepted: Names, credibility: float
) -> tuple[tuple[Names, ...], float]:
    """The sets that hold so much probability together, the likeliest first, and the probability of the accepted one.

    A set that has a better one inside it, or one that is hardly worse, is no other explanation: what it adds is not needed.
    Its probability counts for that one, whose effects are causes in both.

    Args:
        worth: log evidence of each set, less what it has to be better by.
        accepted: one of them.
        credibility: probability that the sets must hold.
    """
    own = next(names for names in worth if set(names) == set(accepted))
    highest = max(worth.values())
    weight: dict[Names, float] = {}
    for names in sorted(worth, key=lambda names: (len(names), -worth[names])):
        within = [one for one in weight if set(one) < set(names) and worth[names] < worth[one] + IDLE]
        counted = names if names == own else max(within, key=worth.__getitem__, default=names)
        weight[counted] = weight.get(counted, 0.0) + float(np.exp(worth[names] - highest))
    total = sum(weight.values())
    likeliest = sorted(weight, key=lambda names: -weight[names])
    held = np.cumsum([weight[names] for names in likeliest]) / total
    count = int(np.searchsorted(held, credibility)) + 1
    return tuple(likeliest[:count]), weight[own] / total
