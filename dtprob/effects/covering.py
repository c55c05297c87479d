"""A few points that cover many."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def covering(place: Float[np.ndarray, "point coordinate"], most: int) -> Int[np.ndarray, " few"]:
    """Which points cover all evenly: the first, then each time the one farthest from those before.

    Source: Gonzalez, Theoretical Computer Science 38 (1985) 293.

    Args:
        place: where they are.
        most: number of points that cover, at most.
    """
    chosen, distance = [0], np.linalg.norm(place - place[0], axis=1)
    while len(chosen) < min(most, len(place)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(place - place[chosen[-1]], axis=1))
    return np.array(chosen)
