"""Bounded functions of whitened rows: what goes together, skewness and tails without the sway of one far row.

Skewness and tails are made of Legendre polynomials of a variable's probability (Neyman's smooth tests): the combination
that sees most of a departure among those that are blind to what a fit moves, a mean or a scale.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.polynomial import hermite_e, laguerre, legendre
from scipy.special import ndtr

_FAR: Final = 2.5
"""Where rows that are not normal are cut off."""
_NODES: Final = 150
"""Of quadrature over a normal variable."""
_COMPLEX_NODES: Final = 60
"""Of quadrature over an exponential one."""


def _basis(orders: tuple[int, ...], probability: np.ndarray) -> np.ndarray:
    """Legendre polynomials (order, ...) of a probability, each of unit variance where that is uniform."""
    unit = np.eye(max(orders) + 1)
    at = 2 * probability - 1
    return np.stack([math.sqrt(2 * k + 1) * legendre.legval(at, unit[k]) for k in orders])


def _blind(seen: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Of projections on a basis: nearest to what is to be seen, at a right angle to what is moved, of length one."""
    rest = seen - moved * (seen @ moved) / (moved @ moved)
    return rest / np.linalg.norm(rest)


def _of_normal(orders: tuple[int, ...], seen: int, moved: int) -> np.ndarray:
    """Weights of polynomials of a normal variable's probability: sees one Hermite polynomial, blind to another."""
    at, weight = hermite_e.hermegauss(_NODES)
    parts = _basis(orders, ndtr(at)) * weight / weight.sum()
    unit = np.eye(seen + 1)
    return _blind(parts @ hermite_e.hermeval(at, unit[seen]), parts @ hermite_e.hermeval(at, unit[moved]))


def _of_power(orders: tuple[int, ...], seen: int, moved: int) -> np.ndarray:
    """The same of a unit exponential variable, and its Laguerre polynomials."""
    at, weight = laguerre.laggauss(_COMPLEX_NODES)
    parts = _basis(orders, -np.expm1(-at)) * weight
    unit = np.eye(seen + 1)
    return _blind(parts @ laguerre.lagval(at, unit[seen]), parts @ laguerre.lagval(at, unit[moved]))


_SKEW_ORDERS: Final = (1, 3, 5)
_TAIL_ORDERS: Final = (2, 4, 6)
_POWER_ORDERS: Final = (1, 2, 3, 4)
_SKEW: Final = _of_normal(_SKEW_ORDERS, seen=3, moved=1)
_TAIL: Final = _of_normal(_TAIL_ORDERS, seen=4, moved=2)
_POWER_TAIL: Final = _of_power(_POWER_ORDERS, seen=2, moved=1)


def skewness(probability: np.ndarray) -> np.ndarray:
    """Of a variable's probability, positive on average where it is skew to the right; no mean of a normal one moves it."""
    return np.tensordot(_SKEW, _basis(_SKEW_ORDERS, probability), axes=1)


def tails(probability: np.ndarray) -> np.ndarray:
    """Of a variable's probability, positive on average where its tails are heavy; no scale of a normal one moves it."""
    return np.tensordot(_TAIL, _basis(_TAIL_ORDERS, probability), axes=1)


def beside(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Values (n, *entry) less what rows (n, component, *entry) tell of them, as learned from all but the first."""
    told = np.moveaxis(rows[1:], 1, 0).reshape(rows.shape[1], -1)
    weights = np.linalg.lstsq(told @ told.T, told @ values[1:].reshape(-1), rcond=None)[0]
    return values - np.einsum("i,ni...->n...", weights, rows)


def complex_tails(row: np.ndarray) -> np.ndarray:
    """The same of the power of a circular normal variable of variance two."""
    probability = -np.expm1(-(np.abs(row) ** 2) / 2.0)
    return np.tensordot(_POWER_TAIL, _basis(_POWER_ORDERS, probability), axes=1)


def scored(row: np.ndarray, *, is_normal: bool) -> np.ndarray:
    """Rows for products: ranks of normal ones, of unit variance; complex ones keep their phase; others are cut off."""
    if not is_normal:
        size = np.abs(row)
        return row * np.minimum(1.0, _FAR / np.maximum(size, _FAR))
    if np.iscomplexobj(row):
        size = np.maximum(np.abs(row), 1e-300)
        return row / size * np.sqrt(-2.0 * np.expm1(-(size**2) / 2.0))
    return _basis((1,), ndtr(row))[0]
