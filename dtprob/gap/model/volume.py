"""What integrating unknowns out adds to the density of the others, to second order."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Volume:
    """Expansion of V_c = -1/2 log |H_c| in what clusters share.

    H_c is the curvature of a cluster's own unknowns; of states that they share, V_c is the part that a cluster is given.

    Attributes:
        index: positions of the shared coordinates, and of effects' parameters, in a flat vector.
        centre: these, about which it is expanded.
        value: V_c there.
        slope: first derivatives.
        bend: second derivatives, none of them upwards.
    """

    index: Int[np.ndarray, " shared"]
    centre: Float[np.ndarray, " shared"]
    value: Float[np.ndarray, " cluster"]
    slope: Float[np.ndarray, "cluster shared"]
    bend: Float[np.ndarray, "cluster shared shared"]

    def at(self, x: Float[np.ndarray, " dimension"]) -> Float[np.ndarray, " cluster"]:
        """V_c at a flat vector."""
        moved = x[self.index] - self.centre
        return self.value + self.slope @ moved + 0.5 * (self.bend @ moved) @ moved

    def gradient(self, x: Float[np.ndarray, " dimension"]) -> Float[np.ndarray, "cluster shared"]:
        """Its derivatives there."""
        return self.slope + self.bend @ (x[self.index] - self.centre)

    def part(self, kept: Int[np.ndarray, " kept"], index: Int[np.ndarray, " kept"]) -> Volume:
        """The expansion in some of its coordinates, the others where they are, and where these stand in a flat vector."""
        bend = self.bend[:, kept][:, :, kept]
        return replace(self, index=index, centre=self.centre[kept], slope=self.slope[:, kept], bend=bend)
