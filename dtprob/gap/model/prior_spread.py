"""Where the prior of a model puts its unknowns, one by one, by draws of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final, final

import numpy as np
from jaxtyping import Float, Int
from scipy import special

DRAWS: Final = 1000
"""Draws that tell it well."""
_TENTH: Final = 1.2815515655446004
"""Standard deviations from a normal distribution's middle to its last tenth."""
_SCORES: Final = sorted([*np.linspace(-3.0, 3.0, 25).tolist(), -_TENTH, _TENTH])


@final
@dataclass(frozen=True)
class PriorSpread:
    """Quantiles of each unconstrained coordinate of the latent sites, which come first in every flat vector.

    Attributes:
        least, largest: of the draws (dimension,).
        quantiles: at rising normal scores from -3 to 3 (score, dimension).
    """

    least: Float[np.ndarray, " dimension"]
    largest: Float[np.ndarray, " dimension"]
    quantiles: Float[np.ndarray, "score dimension"]

    @classmethod
    def of_draws(cls, draws: Float[np.ndarray, "draw dimension"]) -> PriorSpread:
        """By draws of the prior."""
        found = np.quantile(draws, [0.0, *special.ndtr(_SCORES), 1.0], axis=0)
        return cls(found[0], found[-1], found[1:-1])

    @property
    def middle(self) -> Float[np.ndarray, " dimension"]:
        """The median."""
        return self._at(0.0)

    @cached_property
    def deviation(self) -> Float[np.ndarray, " dimension"]:
        """The standard deviation by the middle eight tenths."""
        return (self._at(_TENTH) - self._at(-_TENTH)) / (2 * _TENTH)

    def _at(self, score: float) -> Float[np.ndarray, " dimension"]:
        return self.quantiles[_SCORES.index(score)]

    def score(
        self, x: Float[np.ndarray, " dimension"], index: Int[np.ndarray, " one"]
    ) -> Float[np.ndarray, " one"]:
        """Normal scores among the draws, at most 3 from 0, of some coordinates of a point."""
        return np.array([np.interp(x[i], self.quantiles[:, i], _SCORES) for i in index])

    def usual(self, index: Int[np.ndarray, "..."]) -> tuple[float, float]:
        """Centre and standard deviation of what most of some coordinates have."""
        return float(np.median(self.middle[index])), float(np.median(self.deviation[index]))
