"""What a move promises to gain, in nats: quadratic where it moves locations, as of a normal's scale where it moves spreads.

A spread that is twice too small makes squares of residuals four times too large: to first order that promises many times
what a wider spread gains.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float

_SHARES: Final = np.array([1.0, 0.7, 0.5, 0.35, 0.25, 0.17, 0.12, 0.08, 0.05, 0.03, 0.02, 0.01])
"""Of the step that a quadratic asks for."""
_FARTHEST: Final = 60.0
"""Of a logarithm of a scale."""


def gains(
    rows: Float[np.ndarray, "set cluster row"],
    shifts: Float[np.ndarray, "set cluster row"],
    is_spread: Bool[np.ndarray, "cluster row"],
) -> Float[np.ndarray, " set"]:
    """Nats that each set of data gains by its move, as far along it as is best.

    A row e = (r^2 - 1) / sqrt(2) tells how far a residual r strays; a scale exp(t / sqrt(2)) times as large gains
    -t / sqrt(2) + r^2 (1 - exp(-sqrt(2) t)) / 2.

    Args:
        rows: whitened residuals.
        shifts: whitened shifts by a move, to first order.
        is_spread: rows that tell spreads.
    """
    slope = np.einsum("ncm,ncm->n", shifts, rows)
    curvature = np.einsum("ncm,ncm->n", shifts, shifts)
    step = np.where(curvature > 0, slope / np.maximum(curvature, 1e-300), 0.0)
    if not (is_spread & (shifts != 0).any(axis=0)).any():
        return 0.5 * slope * step
    e, s = rows[:, is_spread], shifts[:, is_spread]
    along = slope - np.einsum("nm,nm->n", s, e)
    bend = curvature - np.einsum("nm,nm->n", s, s)
    squares = np.maximum(1 + np.sqrt(2) * e, 0.0)
    best = np.zeros(len(rows))
    for share in _SHARES:
        t = (share * step)[:, None] * s
        wider = -np.expm1(-np.clip(np.sqrt(2) * t, -_FARTHEST, _FARTHEST))
        spread = (-t / np.sqrt(2) + 0.5 * squares * wider).sum(axis=1)
        best = np.maximum(best, share * step * along - 0.5 * (share * step) ** 2 * bend + spread)
    return best
