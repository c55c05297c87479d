"""Which unknowns that clusters share are drawn in units of another one, as a user writes levels whose spread is unknown.

Of `spread * level[k]` with standard normal levels there is no telling at levels of zero what the spread is: the slope of
the log density along it vanishes there, and nowhere else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import jax
import numpy as np

if TYPE_CHECKING:
    from dtprob.gap.model.problem import Problem

_NOTHING: Final = 1e-9
"""Share of a slope that is rounding."""


def in_units(problem: Problem) -> frozenset[str]:
    """Names of shared normal unknowns of several entries at whose zero the data tell nothing of another shared one.

    Args:
        problem: the model on its data.
    """
    sites = problem.declaration.sites
    shared = [b for b in problem.blocks_of(None) if not b.local]
    asked = [b for b in shared if b.size > 1 and sites[b.name].distribution == "Normal"]
    if not asked:
        return frozenset()
    every = np.concatenate([b.index[0] for b in shared])
    weights, x = np.ones(problem.n_cluster), problem.prior_draws(jax.random.key(0), 1)[0]
    slope = np.abs(problem.compiled.slope(x, weights))
    found = set()
    for block in asked:
        others = np.setdiff1d(every, block.index[0])
        at_zero = x.copy()
        at_zero[block.index] = 0.0
        there = np.abs(problem.compiled.slope(at_zero, weights))
        if (np.isfinite(slope) & (slope > 0) & (there <= _NOTHING * slope))[others].any():
            found.add(block.name)
    return frozenset(found)
