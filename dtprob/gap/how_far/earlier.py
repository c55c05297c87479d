"""What a fit costs on earlier data, of which a reference tells the normal approximation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dtprob.gap.fitting.fit import Fit
from dtprob.gap.model.problem import Problem


class Earlier(NamedTuple):
    """Log density of earlier data at fits, up to a constant, less what it is on average where nothing has changed.

    Attributes:
        value: nats; below zero for a fit that gives up what earlier data say in order to follow these.
        variance: of the value where nothing has changed.
    """

    value: float
    variance: float


def on_earlier_data(problem: Problem, fitted: Fit) -> Earlier:
    """Of the nuisances that a reference informs.

    A right fit too moves, by what the new data tell. With precision L of the reference and covariance S of the fit, the
    quadratic form 1/2 d' L d of its move d has mean 1/2 tr W and variance 1/2 tr W^2, W = 1 - L S.
    """
    value = variance = 0.0
    place = {int(i): k for k, i in enumerate(fitted.global_index)}
    for names, (mean, precision) in problem.known.items():
        index = np.concatenate([problem.layout[name].index.reshape(-1) for name in names])
        move = fitted.x[index] - mean
        at = [place[int(i)] for i in index]
        moved = np.eye(len(index)) - precision @ fitted.covariance[np.ix_(at, at)]
        value += 0.5 * float(np.trace(moved) - move @ precision @ move)
        variance += 0.5 * float(np.trace(moved @ moved))
    return Earlier(value, variance)
