"""What the best possible diagnosis could tell, from how much the candidates look alike and how much the truth tells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

_DRAWS: Final = 2000
_LEVEL: Final = 0.01
_CREDIBILITY: Final = 0.9
_ERROR: Final = 0.02
"""Chance of taking one effect for the other at which two count as resolvable."""
_ROUNDED: Final = 0.01
"""To what the correlations of a report are rounded."""


class Limit(NamedTuple):
    """What the best possible diagnosis of one effect reaches.

    Attributes:
        first: probability that the truth has the largest score of all candidates.
        named: the same where a score must also be larger than those of 99 in 100 sets of data without an effect.
        class_size: mean number of candidates that hold nine tenths of the posterior, all sizes being as likely.
    """

    first: float
    named: float
    class_size: float


def limit(correlation: Float[np.ndarray, "effect effect"], true: int, lambda_: float) -> Limit:
    """The limit of a diagnosis that knows the candidates' scores, one parameter each, to be normal.

    Scores are z = sqrt(lambda) rho + noise, rho their correlation with the truth's, the noise as correlated as they are. By
    simulation with fixed draws, good to about .01.

    Args:
        correlation: of the candidates' scores; where rounding has made it no correlation the nearest one is taken.
        true: position of the true effect.
        lambda_: noncentrality of its score.
    """
    values, vectors = np.linalg.eigh((correlation + correlation.T) / 2)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    root /= np.maximum(np.linalg.norm(root, axis=1, keepdims=True), 1e-12)
    noise = np.random.default_rng(0).standard_normal((_DRAWS, len(root))) @ root.T
    needed = float(np.quantile(np.abs(noise).max(axis=1), 1 - _LEVEL))
    z = np.abs(noise + np.sqrt(lambda_) * (root @ root[true]))
    wins = z[:, true] >= z.max(axis=1)
    weights = -np.sort(-np.exp((z**2 - z.max(axis=1, keepdims=True) ** 2) / 2), axis=1)
    held = np.cumsum(weights, axis=1) / weights.sum(axis=1, keepdims=True)
    return Limit(
        float(wins.mean()),
        float((wins & (z[:, true] > needed)).mean()),
        float((1 + (held < _CREDIBILITY).sum(axis=1)).mean()),
    )


def is_resolvable(
    correlation: Float[np.ndarray, "effect effect"], true: int, lambda_: float, beside: Sequence[int] = ()
) -> bool:
    """Whether an effect can be told from every other candidate with an error of 2%: lambda (1 - |rho|) / 2 >= z^2.

    Args:
        correlation: of the candidates' scores.
        true: position of the effect.
        lambda_: its noncentrality, alone.
        beside: positions of true effects beside it: lambda and rho are what these leave of them.
    """
    others, kept = list(beside), [true, *(k for k in range(len(correlation)) if k not in {true, *beside})]
    explained = correlation[np.ix_(kept, others)]
    among = correlation[np.ix_(others, others)] + _ROUNDED * np.eye(len(others))
    left = correlation[np.ix_(kept, kept)] - explained @ np.linalg.solve(among, explained.T)
    alone = np.maximum(np.diag(left), _ROUNDED)
    alike = np.abs(left[0, 1:]) / np.sqrt(alone[0] * alone[1:])
    told = lambda_ * alone[0] * (1 - min(float(alike.max(initial=0.0)), 1.0)) / 2
    return bool(told >= stats.norm.isf(_ERROR) ** 2)


def correlation_matrix(percent: list[list[int]]) -> Float[np.ndarray, "effect effect"]:
    """The correlations that a report holds, from the rows below the diagonal in hundredths."""
    matrix = np.eye(len(percent))
    for k, row in enumerate(percent):
        matrix[k, :k] = matrix[:k, k] = np.asarray(row, float) / 100
    return matrix
