"""Where a fit may stand that took loadings, and what they load, for their mirror image.

A factor of each cluster that acts on one observation by itself and on another times an unknown g has two modes: g, and -g
with all factors of the other sign, of which the data that tell less of the factors decide. No Newton step leads across.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting.active import activate, own_basis
from dtprob.gap.model.problem import Problem

_TURNS: Final = 0.01
"""Share of what own unknowns do that has to turn with the sign of a shared one that multiplies them."""
_MOST: Final = 32
"""Shared unknowns up to which each is asked."""


def mirrored(problem: Problem, x: Float[np.ndarray, " dimension"]) -> list[Float[np.ndarray, " dimension"]]:
    """For each shared unknown that multiplies clusters' own ones, the point where all these have the other sign.

    Args:
        problem: the model on its data.
        x: a point.
    """
    values = problem.compiled.sites(x)
    real = [b for b in problem.blocks_of(None) if b.size and _is_itself(values[b.name], x[b.index])]
    none = np.zeros(0, int)
    own = np.concatenate([none, *(b.index.reshape(-1) for b in real if b.local)])
    shared = np.concatenate([none, *(b.index.reshape(-1) for b in real if not b.local)])
    if not own.size or not 0 < shared.size <= _MOST:
        return []
    directions = own_basis(problem, activate(problem)) * np.isin(np.arange(len(x)), own)
    here = np.asarray(problem.compiled.linearised(x, directions)[1])
    middle = np.concatenate(
        [none, *(np.full(b.index.size, problem.prior_spread.usual(b.index)[0]) for b in real if b.local)]
    )
    found = []
    for position in shared:
        other = x.copy()
        other[position] = -x[position]
        product = here * np.asarray(problem.compiled.linearised(other, directions)[1])
        if -product.sum(where=product < 0) > _TURNS * (here**2).sum():
            other[own] = 2 * middle - x[own]
            found.append(other)
    return found


def _is_itself(value: Any, coordinates: np.ndarray) -> bool:
    """Whether a site's values are their own coordinates, in whatever order: nothing bounds them."""
    return np.array_equal(np.sort(np.ravel(value)), np.sort(np.ravel(coordinates)))
