"""Bounded functions of whitened rows: what goes together, skewness and tails without the sway of one far row.

Skewness and tails are the Hermite and Laguerre polynomials that stand for them (Neyman's smooth tests), of rows that are
held at some standard deviations, so that one reading counts for no more than a few; what a fit moves, a mean or a scale,
is taken out. Functions of ranks would be bounded, too, but hardly see a few percent of readings that err to one side.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.polynomial import Polynomial
from scipy.special import ndtr

_FAR: Final = 2.5
"""Where rows that are not normal are cut off, in products."""
_FAR_SKEW: Final = 3.0
_FAR_TAIL: Final = 2.5
"""Standard deviations at which a normal row is held: of a fourth power sooner, whose sums are skew themselves."""
_FAR_POWER: Final = 5.0
"""Mean powers at which that of a complex row is held."""
_FARTHEST: Final = 6.0
_FARTHEST_POWER: Final = 18.0
"""The same where a few rows that lie far out are looked for among many."""
_NODES: Final = 200_001
"""Of quadrature over what has corners where it is held."""


def _held(
    seen: Polynomial, moved: Polynomial, far: float, density: Callable[[np.ndarray], np.ndarray], low: float
) -> Callable[[np.ndarray], np.ndarray]:
    """A polynomial of what is held within `far`: of mean zero and variance one, at a right angle to another polynomial.

    Args:
        seen: the polynomial.
        moved: the other one, of which a multiple is taken out, held as well.
        far: where the variable is held, on both sides.
        density: of the variable.
        low: its smallest value.
    """
    at = np.linspace(low, 40.0, _NODES)
    weight = density(at)
    weight[[0, -1]] /= 2.0
    weight /= weight.sum()
    values, other = (one(np.clip(at, -far, far)) for one in (seen, moved))
    away = moved(at) - weight @ moved(at)
    rest = seen - moved * float((weight * away) @ values / ((weight * away) @ other))
    left = rest(np.clip(at, -far, far))
    mean = float(weight @ left)
    whole = (rest - mean) / float(np.sqrt(weight @ (left - mean) ** 2))
    return lambda x: whole(np.clip(x, -far, far))


def _normal(x: np.ndarray) -> np.ndarray:
    return np.exp(-(x**2) / 2)


_SKEWNESS: Final = _held(Polynomial([0, -3, 0, 1]), Polynomial([0, 1]), _FAR_SKEW, _normal, -40.0)
_TAILS: Final = _held(Polynomial([3, 0, -6, 0, 1]), Polynomial([-1, 0, 1]), _FAR_TAIL, _normal, -40.0)
_FEW: Final = _held(Polynomial([3, 0, -6, 0, 1]), Polynomial([-1, 0, 1]), _FARTHEST, _normal, -40.0)
_POWER_TAILS, _FEW_POWERS = (
    _held(Polynomial([1, -2, 0.5]), Polynomial([1, -1]), far, lambda x: np.exp(-x), 0.0)
    for far in (_FAR_POWER, _FARTHEST_POWER)
)


def skewness(row: np.ndarray) -> np.ndarray:
    """Of a normal row, positive on average where it is skew to the right; no mean moves it."""
    return _SKEWNESS(row)


def tails(row: np.ndarray) -> np.ndarray:
    """Of a normal row, positive on average where its tails are heavy; no scale moves it."""
    return _TAILS(row)


def few(row: np.ndarray) -> np.ndarray:
    """As `tails`, or `complex_tails`, but held so far out that a few of many rows count."""
    return _FEW_POWERS(np.abs(row) ** 2 / 2.0) if np.iscomplexobj(row) else _FEW(row)


def beside(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Values (n, *entry) less what rows (n, component, *entry) tell of them, as learned from all but the first."""
    told = np.moveaxis(rows[1:], 1, 0).reshape(rows.shape[1], -1)
    weights = np.linalg.lstsq(told @ told.T, told @ values[1:].reshape(-1), rcond=None)[0]
    return values - np.einsum("i,ni...->n...", weights, rows)


def dispersion(row: np.ndarray) -> np.ndarray:
    """Of a normal row, its square, as far as a row may count."""
    return np.clip(row, -_FAR_TAIL, _FAR_TAIL) ** 2


def complex_tails(row: np.ndarray) -> np.ndarray:
    """The same of the power of a circular normal variable of variance two."""
    return _POWER_TAILS(np.abs(row) ** 2 / 2.0)


def scored(row: np.ndarray, *, is_normal: bool) -> np.ndarray:
    """Rows for products: ranks of normal ones, of unit variance; complex ones keep their phase; others are cut off."""
    if not is_normal:
        size = np.abs(row)
        return row * np.minimum(1.0, _FAR / np.maximum(size, _FAR))
    if np.iscomplexobj(row):
        size = np.maximum(np.abs(row), 1e-300)
        return row / size * np.sqrt(-2.0 * np.expm1(-(size**2) / 2.0))
    return math.sqrt(3.0) * (2.0 * ndtr(row) - 1.0)
