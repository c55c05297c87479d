"""Arrays with Kronecker codebooks of oversampled DFT beams: what each beam gathers, and the rate.

A base station has a planar array with columns of 10 elements, a user a line of one or more, all at half a
wavelength. Along each of these three lines of M elements a path with direction cosine u has the response
a[m] = exp(j pi m u) / sqrt(M), and a beam is the response to a cosine on a grid, four per element.

The share of the power that a beam gathers along a line is a trigonometric polynomial of its cosine. So what
all beams gather is known from 2 (M - 1) coefficients, and averages of shares are averages of coefficients.
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


class Arrays(NamedTuple):
    """The antennas of both ends.

    Attributes:
        rows: elements of a row of the base station's array.
        user: elements of the user's line.
    """

    rows: int
    user: int = 1

    @property
    def elements(self) -> tuple[int, int, int]:
        """Elements of a row, of a column and of the user's line."""
        return self.rows, VERTICAL, self.user

    @property
    def entries(self) -> int:
        """Coefficients of all three lines."""
        return sum(2 * (elements - 1) for elements in self.elements)

    @property
    def antennas(self) -> int:
        """Elements of the base station's array."""
        return VERTICAL * self.rows


def cosines(paths: BeamPaths) -> tuple[Float[np.ndarray, "position path"], ...]:
    """The direction cosines of paths along the three lines."""
    return paths.horizontal, paths.vertical, paths.arrival


def grid(elements: int) -> Float[np.ndarray, " beam"]:
    """The direction cosines of the beams of a line of elements."""
    count = OVERSAMPLING * elements
    return (2 * np.arange(count) - count) / count


def response(elements: int, cosine: Float[np.ndarray, "*shape"]) -> Complex[np.ndarray, "*shape"]:
    """w^H a of a beam and a path whose direction cosines differ by `cosine`."""
    half = np.pi / 2 * cosine
    base = elements * np.sin(half)
    flat = np.abs(base) < 1e-9
    turned = np.exp(1j * (elements - 1) * half)
    return turned * np.where(
        flat, np.cos((elements - 1) * half), np.sin(elements * half) / np.where(flat, 1.0, base)
    )


def coefficients(
    power: Float[np.ndarray, "position path"], cosine: Float[np.ndarray, "position path"], elements: int
) -> Float[np.ndarray, "position entry"]:
    """What the beams of a line gather, paths adding in power, as coefficients of cosines, then of sines.

    The constant, which is the same everywhere, is left out; the squared distance of two vectors of
    coefficients is that of the shares of all beams.

    Args:
        power: of the paths, in any unit.
        cosine: their direction cosines along the line.
        elements: of the line.
    """
    total = power.sum(axis=1)
    weight = power.T / np.where(total > 0, total, 1.0)
    turn = np.exp(1j * np.pi * np.ascontiguousarray(cosine.T))
    found = np.empty((elements - 1, len(power)), complex)
    for degree in range(elements - 1):
        weight = weight * turn
        found[degree] = weight.sum(axis=0)
    found *= _scale(elements)[:, None]
    return np.concatenate([np.real(found), np.imag(found)]).T


def gathered(
    coefficient: Float[np.ndarray, "position entry"], elements: int
) -> Float[np.ndarray, "position beam"]:
    """The share of the power that each beam of a line gathers, from coefficients."""
    count = OVERSAMPLING * elements
    real, imaginary = np.split(coefficient, 2, axis=1)
    signs = (-1.0) ** np.arange(1, elements)
    spectrum = np.full((len(coefficient), count // 2 + 1), 0j)
    spectrum[:, 0] = 1 / elements
    size = (1 - np.arange(1, elements) / elements) / elements
    spectrum[:, 1:elements] = signs * size / _scale(elements) * (real - 1j * imaginary)
    return count * np.fft.irfft(spectrum, count, axis=1)


def _scale(elements: int) -> Float[np.ndarray, " degree"]:
    """What makes distances of coefficients those of shares."""
    return np.sqrt(2 * OVERSAMPLING / elements) * (1 - np.arange(1, elements) / elements)


def labels(paths: BeamPaths, arrays: Arrays) -> Float[np.ndarray, "position entry"]:
    """The coefficients along all three lines, on average over the phases of the paths."""
    power = np.abs(paths.gain) ** 2
    lines = zip(cosines(paths), arrays.elements, strict=True)
    return np.concatenate([coefficients(power, cosine, elements) for cosine, elements in lines], axis=1)


def chosen(expected: Float[np.ndarray, "position entry"], arrays: Arrays) -> Int[np.ndarray, "position 3"]:
    """Along each line the beam that is expected to gather most."""
    ends = np.cumsum([2 * (elements - 1) for elements in arrays.elements])
    parts = zip(np.split(expected, ends[:-1], axis=1), arrays.elements, strict=True)
    return np.stack([np.argmax(gathered(part, elements), axis=1) for part, elements in parts], axis=1)


def rates(
    paths: BeamPaths, beams: Int[np.ndarray, "position 3"], arrays: Arrays
) -> Float[np.ndarray, " position"]:
    """Achievable rate with the beams of both ends at each position, bit/s/Hz, paths adding in amplitude.

    Args:
        paths: of the positions.
        beams: of a row, a column and the user's line, at each position.
        arrays: of both ends.
    """
    amplitude = np.sqrt(np.prod(arrays.elements)) * paths.gain
    for beam, cosine, elements in zip(beams.T, cosines(paths), arrays.elements, strict=True):
        amplitude = amplitude * response(elements, cosine - grid(elements)[beam][:, None])
    return np.log2(1 + SNR * np.abs(amplitude.sum(axis=1)) ** 2)
