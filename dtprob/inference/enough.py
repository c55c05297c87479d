"""Whether chains have been run for long enough: by effective sample size and r-hat."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from dtprob.inference.target import Target

LOOK_EVERY = 200
"""Draws of each chain between two looks; fixed, so that chunks and interruptions do not move the end."""


@dataclass(frozen=True)
class Enough:
    """When to stop before all draws are made.

    Attributes:
        ess: bulk effective sample size over all chains that every coordinate must have; 0 never stops.
        rhat: rank-normalised r-hat that no coordinate may exceed (where there are several chains).
    """

    ess: int
    rhat: float

    def is_look(self, draws: int) -> bool:
        """Whether to look after so many draws of each chain."""
        return self.ess > 0 and draws > 0 and draws % LOOK_EVERY == 0

    def reached(self, target: Target, positions: Float[np.ndarray, "chain draw dimension"]) -> bool:
        """Whether all coordinates suffice; of an angle its cosine and its sine.

        A coordinate that never moves, or is not a number, does not: there the effective sample size means nothing.

        Args:
            target: what the chains are of.
            positions: the draws so far.
        """
        from arviz_stats.base import array_stats  # noqa: PLC0415  (takes a second)

        stats = cast("Any", array_stats)
        for parts in _coordinates(target, positions):
            moving = [values for values in parts if np.ptp(values) > 0]
            for values in moving:
                if not stats.ess(values, chain_axis=0, draw_axis=1) >= self.ess:
                    return False
                if len(values) > 1 and not stats.rhat(values, chain_axis=0, draw_axis=1) <= self.rhat:
                    return False
            if not moving:
                return False
        return True


NEVER = Enough(0, 1.0)


def _coordinates(target: Target, positions: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """What is looked at of each coordinate."""
    for index in target.angles:
        yield np.cos(positions[..., index]), np.sin(positions[..., index])
    for index in target.linear:
        yield (positions[..., index],)
