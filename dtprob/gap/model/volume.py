"""What integrating the clusters' own unknowns out adds to the density of the shared ones, to second order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Volume:
    """Expansion of V_c = -1/2 log |H_c| in the base model's shared coordinates, H_c the curvature of a cluster's own ones.

    Attributes:
        centre: the shared coordinates about which it is expanded.
        value: V_c there.
        slope: first derivatives.
        bend: second derivatives, none of them upwards.
    """

    centre: Float[np.ndarray, " shared"]
    value: Float[np.ndarray, " cluster"]
    slope: Float[np.ndarray, "cluster shared"]
    bend: Float[np.ndarray, "cluster shared shared"]

    def at(self, shared: Float[np.ndarray, " shared"]) -> Float[np.ndarray, " cluster"]:
        """V_c at shared coordinates."""
        moved = shared - self.centre
        return self.value + self.slope @ moved + 0.5 * (self.bend @ moved) @ moved

    def gradient(self, shared: Float[np.ndarray, " shared"]) -> Float[np.ndarray, "cluster shared"]:
        """Its derivatives there."""
        return self.slope + self.bend @ (shared - self.centre)
