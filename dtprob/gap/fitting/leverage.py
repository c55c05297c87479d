"""What fitting each cluster's own unknowns takes off the squares of its residuals.

At the mode of a cluster's own unknowns the residual of reading i has the variance 1 - h_i, h_i its leverage, so rows that
tell of spreads are too low on average, most where a cluster has few readings. Data sets drawn at the fit are not refitted,
and have none of it.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting.projection import Projection
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation.likelihoods import LIKELIHOODS


def lost_spread(problem: Problem, projection: Projection) -> Float[np.ndarray, "cluster row"]:
    """Means of the rows of the data at a fit, with the sign changed: zero but for the spreads of normal observations.

    Where the fit is a joint mode of all unknowns, the spreads that clusters share have taken up their part already.

    Args:
        problem: the model on its data.
        projection: at the fit.
    """
    own = projection.local_columns
    if not own.shape[-1]:
        return np.zeros(own.shape[:2])
    leverage = np.einsum("cri,cij,crj->cr", own, projection.local_inverse, own)
    parts = problem.by_observation(leverage)
    for name, rows in parts.items():
        scale, located = LIKELIHOODS[problem.families[name]].log_scale, problem.located[name]
        spread = None if scale is None else scale * rows[:located].sum(axis=0)
        rows[:] = 0.0
        if spread is not None and located < len(rows):
            rows[located] = spread
    lost = np.asarray(problem.rows.stack({name: jnp.asarray(rows) for name, rows in parts.items()}))
    return lost if problem.volume is not None else _without(lost, projection.columns)


def _without(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Rows (cluster, row) less what columns (cluster, row, i) tell of them."""
    flat = columns.reshape(-1, columns.shape[-1])
    return rows - (flat @ np.linalg.lstsq(flat, rows.reshape(-1), rcond=None)[0]).reshape(rows.shape)
