"""The convolutional perfectly matched layer: what swallows waves at the edges of a grid.

Source: J. A. Roden and S. D. Gedney, Convolution PML (CPML), Microw. Opt. Technol. Lett. 27 (2000), with no
stretching of real coordinates, so that the layer only adds a memory to each difference across it.
"""

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.constants import epsilon_0, mu_0

from dtprob.physical.wave.grid import ABSORBER, Grid

_GRADING: Final = 3
_STRENGTH: Final = 0.8
"""Largest conductivity over (grading + 1) / (eta0 d)."""
_SHIFT: Final = 0.1
"""Frequency below which the layer stops swallowing, over the source's."""


class Layer(NamedTuple):
    """Recursion psi <- decay psi + gain difference, over the first and then the last cells of an axis.

    Attributes:
        decay: per cell.
        gain: per cell.
    """

    decay: Float[np.ndarray, " cell"]
    gain: Float[np.ndarray, " cell"]


def layers(grid: Grid, frequency: float) -> tuple[Layer, Layer]:
    """The layers of differences of the electric and of the magnetic field.

    The first lie half way between nodes, the second at nodes but the outermost.

    Args:
        grid: of the simulation.
        frequency: of the source, Hz.
    """
    half = np.arange(ABSORBER) + 0.5
    whole = np.arange(1, ABSORBER + 1)
    return _layer(grid, frequency, half), _layer(grid, frequency, whole)


def _layer(grid: Grid, frequency: float, place: Float[np.ndarray, " half"]) -> Layer:
    """Of positions from the first node, in cells; mirrored at the other end."""
    depth = np.clip(1 - place / ABSORBER, 0, 1)
    impedance = np.sqrt(mu_0 / epsilon_0)
    loss = _STRENGTH * (_GRADING + 1) / (impedance * grid.spacing) * depth**_GRADING
    shift = 2 * np.pi * frequency * _SHIFT * epsilon_0 * (1 - depth)
    decay = np.exp(-(loss + shift) * grid.step / epsilon_0)
    gain = np.divide(loss, loss + shift, out=np.zeros_like(loss), where=loss > 0) * (decay - 1)
    return Layer(np.concatenate([decay, decay[::-1]]), np.concatenate([gain, gain[::-1]]))
