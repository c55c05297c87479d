"""How well a fit predicts or explains, as rivals judge it: leave-one-cluster-out and BIC."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem

_HIGHEST = 1 - 1e-9
"""Leverage of a cluster beyond which leaving it out says nothing."""


def loo(problem: Problem, fitted: Fit) -> Float[np.ndarray, " cluster"]:
    """Log predictive density of each cluster given all others, in Laplace's approximation.

    The posterior is normal with the fit's curvature H, to which the cluster with tangents W and residuals e contributes
    F = W'W: log p(y_i | y_-i) = log p(y_i | x) + 1/2 log|I - H^-1 F| - 1/2 e'W (H - F)^-1 W'e. Exact for linear normal
    models; importance-sampled LOO estimates the same (Vehtari, Gelman & Gabry, Stat. Comput. 27 (2017) 1413).

    Args:
        problem: in which the fit's effects are live.
        fitted: a mode.
    """
    projection = project(problem, fitted)
    shared = projection.reduced @ _root(projection.global_inverse)
    own = projection.local_columns @ _root(projection.local_inverse)
    w = np.concatenate([shared, own], axis=-1)
    residual = np.asarray(problem.compiled.residual(fitted.x))
    leverage, vectors = np.linalg.eigh(np.swapaxes(w, 1, 2) @ w)
    kept = 1 - np.clip(leverage, 0.0, _HIGHEST)
    slope = np.einsum("cmk,cm,ckj->cj", w, residual, vectors)
    likelihood = problem.compiled.evaluate(fitted.x).likelihood
    return likelihood + 0.5 * (np.log(kept) - slope**2 / kept).sum(axis=1)


def bic(problem: Problem, fitted: Fit) -> Float[np.ndarray, " 1"]:
    """Log likelihood of the effects at the fit, nuisances and fields integrated out, less log(n) / 2 per parameter.

    Minus half of the Bayesian information criterion (Schwarz, Ann. Stat. 6 (1978) 461); a random field has one parameter,
    its standard deviation.

    Args:
        problem: in which the fit's effects are live.
        fitted: a mode.
    """
    chosen = [e for e in problem.live if e.name in fitted.effects]
    fields = tuple(e.name for e in chosen if e.kind == "variance")
    size = sum(e.dimension for e in chosen)
    held = fitting.fit(problem, fitted.x, fields, spread=fitted.spread, steps=0)
    return np.array([held.log_evidence - 0.5 * size * np.log(problem.observed.count)])


def _root(matrix: np.ndarray) -> np.ndarray:
    """Lower triangular roots (..., n, n)."""
    return np.linalg.cholesky((matrix + np.swapaxes(matrix, -1, -2)) / 2)
