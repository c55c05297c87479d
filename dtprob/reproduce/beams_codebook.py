"""A planar array with a Kronecker codebook of oversampled DFT beams: what each beam gathers, and the rate.

The array has columns of 10 elements at half a wavelength; a path with direction cosines u (horizontal) and v
(vertical) has the response a_y(u) (x) a_z(v), a[m] = exp(j pi m u) / sqrt(M). A beam is the response to a
direction cosine on a grid, four times as many as there are elements.
"""

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from dtprob.reproduce.beams import BeamPaths

VERTICAL: Final = 10
"""Elements of a column."""

OVERSAMPLING: Final = 4

SNR: Final = 10 ** ((40.0 - (-174.0 + 70.0)) / 10)
"""Transmitted power over noise: 40 dBm, 10 MHz, -174 dBm/Hz."""


class Beams(NamedTuple):
    """A pair of beams per position: indices into the codebooks of the rows and of the columns."""

    horizontal: Int[np.ndarray, " position"]
    vertical: Int[np.ndarray, " position"]


def grid(elements: int) -> Float[np.ndarray, " beam"]:
    """The direction cosines of the beams of a line of elements."""
    count = OVERSAMPLING * elements
    return (2 * np.arange(count) - count) / count


def response(elements: int, cosine: Float[np.ndarray, "*shape"]) -> Complex[np.ndarray, "*shape"]:
    """w^H a of a beam and a path whose direction cosines differ by `cosine`."""
    return _kernel(elements, cosine) * np.exp(0.5j * np.pi * (elements - 1) * cosine)


def _kernel(elements: int, cosine: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The response with the phase taken at the centre of the line."""
    half = np.pi / 2 * cosine
    base = elements * np.sin(half)
    flat = np.abs(base) < 1e-9
    return np.where(flat, np.cos((elements - 1) * half), np.sin(elements * half) / np.where(flat, 1.0, base))


def shares(
    power: Float[np.ndarray, "position path"], cosine: Float[np.ndarray, "position path"], elements: int
) -> Float[np.ndarray, "position beam"]:
    """The share of the power that each beam of a line gathers, paths adding in power; 0 where there is none.

    Args:
        power: of the paths, in any unit.
        cosine: their direction cosines along the line.
        elements: of the line.
    """
    total = power.sum(axis=1, keepdims=True)
    weight = power / np.where(total > 0, total, 1.0)
    gathered = np.zeros((len(power), OVERSAMPLING * elements))
    for column in range(power.shape[1]):
        kernel = _kernel(elements, cosine[:, column, None] - grid(elements))
        gathered += weight[:, column, None] * kernel**2
    return gathered


def rates(paths: BeamPaths, beams: Beams, rows: int) -> Float[np.ndarray, " position"]:
    """Achievable rate with a pair of beams at each position, bit/s/Hz, paths adding in amplitude.

    Args:
        paths: of the positions.
        beams: one pair per position.
        rows: elements of a row; the array has `VERTICAL` times as many.
    """
    horizontal = response(rows, paths.horizontal - grid(rows)[beams.horizontal][:, None])
    vertical = response(VERTICAL, paths.vertical - grid(VERTICAL)[beams.vertical][:, None])
    amplitude = np.sqrt(rows * VERTICAL) * np.sum(paths.gain * horizontal * vertical, axis=1)
    return np.log2(1 + SNR * np.abs(amplitude) ** 2)
