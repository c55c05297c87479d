"""Parameters at an end of a bounded prior: where the data push one there it is far from normal in its own coordinate."""

from __future__ import annotations

from typing import Final

import jax
import numpy as np
from jaxtyping import Float
from numpyro.distributions import constraints
from scipy import special

from dtprob.gap.fitting.fit import Fit
from dtprob.gap.model.problem import Problem
from dtprob.models.declaration import base_constraint

_NEAR: Final = 0.02
"""Share of a prior's range within which a value is at its end."""
_WIDE: Final = 1.0
"""Deviation of its log odds along the range from which on the data do not tell how near."""
_TIMES: Final = 20
"""Points among which one is drawn, for each draw."""
_ENOUGH: Final = 10.0
"""Points that have to count for the draws to be better than normal ones."""


def at_end(problem: Problem, fitted: Fit) -> tuple[str, ...]:
    """Parameters that clusters share, each entry by name, at an end of its prior."""
    deviation = np.zeros(problem.dimension)
    deviation[fitted.global_index] = np.sqrt(np.diag(fitted.covariance))
    found: list[str] = []
    for block in (b for b in problem.blocks_of(None) if not b.local):
        site, index = problem.declaration.sites.get(block.name), block.index[0]
        if site is None or not isinstance(base_constraint(site.support), constraints.interval):
            continue
        share = special.expit(fitted.x[index])
        near = (np.minimum(share, 1 - share) < _NEAR) & (deviation[index] > _WIDE)
        found += [block.name if len(index) == 1 else f"{block.name}[{j}]" for j in np.flatnonzero(near)]
    return tuple(found)


def shared_draws(
    problem: Problem, fitted: Fit, count: int, key: jax.Array
) -> Float[np.ndarray, "draw dimension"]:
    """Points about a fit, what clusters share drawn from its normal approximation.

    Where a parameter is at an end of its prior, and clusters own nothing, they are drawn again by their posterior density
    over the normal one (sampling importance resampling, Rubin 1987).
    """
    weighed = bool(at_end(problem, fitted)) and not any(b.local for b in problem.blocks_of(None))
    noise = np.asarray(jax.random.normal(key, (count * (_TIMES if weighed else 1), len(fitted.global_index))))
    points = np.tile(fitted.x, (len(noise), 1))
    if len(fitted.global_index):
        points[:, fitted.global_index] += noise @ np.linalg.cholesky(fitted.covariance).T
    if not weighed:
        return points
    log_weight = problem.compiled.profile(points) + (noise**2).sum(axis=1) / 2
    log_weight = np.where(np.isfinite(log_weight), log_weight, -np.inf)
    weight = special.softmax(log_weight) if np.isfinite(log_weight).any() else np.zeros(len(noise))
    if (weight**2).sum() * _ENOUGH > 1 or not weight.any():
        return points[:count]
    return points[np.searchsorted(np.cumsum(weight), (np.arange(count) + 0.5) / count)]
