"""Effects that a fit leaves at their null, since data push them below it."""

from __future__ import annotations

from typing import Final

import numpy as np

from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.plausible import nulls, sides, sizes
from dtprob.gap.model.problem import Problem

_AT_NULL: Final = 0.01
"""Standard deviations of its posterior within which a size stands at its null: one that data call for is farther off."""


def bound(problem: Problem, fitted: Fit) -> tuple[str, ...]:
    """Mean effects of a fit all of whose sizes cannot be below their null, and stand there.

    They explain nothing, and yet whatever they would move is taken to be fitted.

    Args:
        problem: in which the effects are live.
        fitted: the fit.
    """
    deviation = dict(zip(fitted.global_index.tolist(), np.sqrt(np.diag(fitted.covariance)), strict=True))
    found: list[str] = []
    for effect in (e for e in problem.live if e.name in fitted.effects and e.kind == "mean"):
        index, own = problem.layout.of(effect), sizes(effect)
        above = np.abs(fitted.x[index] - nulls(effect))[own]
        near = _AT_NULL * np.array([deviation[i] for i in index[own].tolist()])
        if sides(effect)[own].all() and np.all(above <= near):
            found.append(effect.name)
    return tuple(found)
