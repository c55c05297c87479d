"""How far the data determine the entries of random fields, and thereby how far these spread."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from scipy import special

from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.density import system_at
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.newton import positive
from dtprob.gap.model.layout import Block
from dtprob.gap.model.problem import Problem

_FEWEST: Final = 2.0
"""Entries that count as determined at least: of one a spread of any size is told, but for its prior."""
_TAILS: Final = np.array([0.05, 0.95])
"""Probabilities above the quantiles that bound a 90% interval."""


def shared_weights(problem: Problem, fitted: Fit, name: str) -> float:
    """Number of a field's entries that the data determine, sum (1 - var / sd^2); none where clusters have their own."""
    if _field(problem, name).local:
        return 0.0
    return float(np.trace(_determined(problem, fitted, name)[0]))


def interval_of_spread(problem: Problem, fitted: Fit, name: str) -> tuple[float, float]:
    """90% interval of a field's standard deviation s: nu s^2 over its square is chi-square of nu = sum gamma^2 degrees.

    The Fisher information of log s in normal data, whose directions have variances s^2 + 1 / J, is 2 sum gamma^2, with
    gamma = 1 - var / s^2 the share of each direction that the data determine (MacKay, Neural Computation 4 (1992) 415): as
    much as that many entries tell that are known exactly.

    Args:
        problem: in which the field is live.
        fitted: the fit that has it.
        name: of its effect.
    """
    total = max(float(np.sum(_determined(problem, fitted, name) ** 2)), _FEWEST)
    low, high = np.sqrt(total / special.chdtri(total, _TAILS))
    return fitted.spread[name] * float(low), fitted.spread[name] * float(high)


def _determined(problem: Problem, fitted: Fit, name: str) -> Float[np.ndarray, "part entry entry"]:
    """I - covariance / s^2 of a field's entries: all that clusters share in one part, or each cluster's given the rest."""
    block = _field(problem, name)
    if block.local:
        active = activate(problem, fitted.effects, spread=fitted.spread)
        own = np.flatnonzero(np.isin(active.local_index[0], block.index[0]))
        covariance = np.linalg.inv(positive(system_at(problem, active, fitted.x).local))
        covariance = covariance[:, own[:, None], own]
    else:
        place = {int(i): j for j, i in enumerate(fitted.global_index)}
        own = np.array([place[int(i)] for i in block.index[0]])
        covariance = fitted.covariance[own[:, None], own][None]
    return np.eye(len(own)) - covariance / fitted.spread[name] ** 2


def _field(problem: Problem, name: str) -> Block:
    return problem.field_of(next(e for e in problem.live if e.name == name))
