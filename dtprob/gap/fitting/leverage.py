"""What fitting each cluster's own unknowns takes off the squares of its residuals.

At the mode of a cluster's own unknowns the residual of reading i has the variance 1 - h_i, h_i its leverage, so rows that
tell of spreads are too low on average, most where a cluster has few readings. Data sets drawn at the fit are not refitted,
and have none of it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting.projection import Projection
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation import whiten


def lost_spread(problem: Problem, projection: Projection) -> Float[np.ndarray, "cluster row"]:
    """Means of the rows of the data at a fit, with the sign changed: zero but for the spreads of normal observations.

    Where the fit is a joint mode of all unknowns, the spreads that clusters share have taken up their part already.

    Args:
        problem: the model on its data.
        projection: at the fit.
    """
    own = projection.local_columns
    lost = np.zeros(own.shape[:2])
    if not own.shape[-1]:
        return lost
    leverage = np.einsum("cri,cij,crj->cr", own, projection.local_inverse, own)
    flat, found, start = problem.rows.unstack(leverage), [], 0
    for name, count in problem.components.items():
        shape = problem.declaration.observed[name].shape
        size = count * int(np.prod(shape, dtype=int))
        rows, located = flat[start : start + size].reshape(count, *shape), problem.located[name]
        start += size
        part, scale = np.zeros_like(rows), whiten.log_scale(problem.families[name])
        if scale is not None and located < count:
            part[located] = scale * rows[:located].sum(axis=0)
        found.append(part.reshape(-1))
    padded = np.concatenate([*found, np.zeros(1)])
    lost = padded[problem.rows.gather]
    return lost if problem.volume is not None else _without(lost, projection.columns)


def _without(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Rows (cluster, row) less what columns (cluster, row, i) tell of them."""
    flat = columns.reshape(-1, columns.shape[-1])
    return rows - (flat @ np.linalg.lstsq(flat, rows.reshape(-1), rcond=None)[0]).reshape(rows.shape)
