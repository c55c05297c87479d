"""What fitting unknowns that are integrated out takes off the rows that tell of spreads.

At the mode of a cluster's own unknowns, or of states, the residual of reading i has the variance 1 - h_i, h_i its leverage,
so these rows are too low on average, most where a cluster has few readings. Data sets drawn at the fit are not refitted,
and have none of it. What is lost is the slope of -1/2 log |H|, H the curvature of these unknowns, which
integrating them out by Laplace's method adds to the log density (Tierney and Kadane 1986).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting.active import Active, activate, basis, own_basis
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.projection import Projection
from dtprob.gap.fitting.states import are_states
from dtprob.gap.model.problem import Problem


def lost(problem: Problem, fitted: Fit, projection: Projection) -> Float[np.ndarray, "cluster row"]:
    """Means of the first spread rows of the data at a fit, with the sign changed; all are zero where one is not finite.

    Where the fit is a joint mode of all unknowns, what clusters share has taken up its part already; a projection leaves
    nothing of that.

    Args:
        problem: the model on its data.
        fitted: the fit.
        projection: there.
    """
    active = activate(problem, fitted.effects, spread=fitted.spread)
    weights, along = _integrated(problem, active, projection)
    if not len(along):
        return np.zeros(weights.shape[:2])
    rows = {}
    for name, slope in problem.compiled.bend(fitted.x, weights, along).items():
        part, located = np.zeros((problem.rows.components[name], *slope.shape)), problem.located[name]
        if located < len(part):
            part[located] = -np.asarray(slope)
        rows[name] = jnp.asarray(part)
    found = np.asarray(problem.rows.stack(rows))
    return found if np.isfinite(found).all() else np.zeros_like(found)


def _integrated(problem: Problem, active: Active, projection: Projection) -> tuple[np.ndarray, np.ndarray]:
    """Tangents times the covariance (cluster, row, k) of what is integrated out, and its directions (k, dimension)."""
    inner = are_states(problem, active)
    own, along = projection.local_columns @ projection.local_inverse, own_basis(problem, active)
    if not inner.any():
        return own, along
    states = projection.columns[..., inner] @ projection.alone(inner)
    along_states = basis(problem, active)[: len(inner)][inner]
    return np.concatenate([states, own], axis=-1), np.concatenate([along_states, along])
