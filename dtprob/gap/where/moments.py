"""What neither mean nor spread tells of observations: their skewness and tails, and what goes together.

Rows of a right twin are independent of each other, and normal where the observation is. Dependence is the product of two
rows; skewness and tails are smooth functions of a normal row that no small change of its mean or scale moves (Neyman's
smooth tests with fitted parameters: Thomas and Pierce, JASA 74 (1979)). What each is of a right twin, replicates tell.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from scipy.special import ndtr

from dtprob.gap.model.problem import Problem
from dtprob.gap.observation.likelihoods import LIKELIHOODS
from dtprob.gap.where.families import Family, Pattern

_MOST: Final = 1 << 16
"""Entries of an observation up to which it is looked at."""
_OUTPUTS: Final = 8
"""Entries of a last axis up to which each pair is looked at."""
_ODD: Final = math.sqrt(3.0 / math.pi)
_EVEN: Final = math.sqrt(15.0 / 2.0) / math.pi
"""Covariance of the first two Legendre polynomials of a normal variable's probability with the variable and its square."""

_MOMENTS: Final = ("spread", "skewness", "tails", "dependence")
"""First words of kinds that are no change of values."""


def moment(family: str) -> str | None:
    """What of an observation a family of this label moves, if not values: "spread", "dependence along link"."""
    kind = family.partition(",")[0]
    return kind if kind.split(" ")[0] in _MOMENTS else None


def further_moments(problem: Problem, rows: np.ndarray) -> Iterator[tuple[str, Family, np.ndarray]]:
    """Each observation that is no outcome, what of it is looked at, how that is pooled, and its scores (n, entry).

    Args:
        problem: the model and candidates on their data.
        rows: projected ones (n, cluster, row), of the data first.
    """
    looked = {
        name: own[:, 0]
        for name, own in problem.by_observation(rows).items()
        if problem.located[name] == 1
        and not LIKELIHOODS[problem.families[name]].is_outcome
        and own[0, 0].size <= _MOST
    }
    for name, row in looked.items():
        axes = problem.declaration.observed[name].axes
        others = {
            n: r for n, r in looked.items() if n > name and problem.declaration.observed[n].axes == axes
        }
        normal = LIKELIHOODS[problem.families[name]].log_scale is not None
        for kind, values in (*(_shape(row) if normal else ()), *_dependence(row, axes, others)):
            centred = values - values[1:].mean(axis=0)
            for kept in ((), *((i,) for i in range(len(axes)) if values.shape[1 + i] > 1)):
                rest = tuple(1 + i for i in range(values.ndim - 1) if i not in kept)
                pattern = Pattern(axes[kept[0]] if kept else "common", kept)
                yield name, Family(kind, pattern, np.ones(())), centred.sum(rest).reshape(len(values), -1)


def _shape(row: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    yield "skewness", skewness(row)
    yield "tails", tails(row)


def _dependence(
    row: np.ndarray, axes: tuple[str, ...], others: dict[str, np.ndarray]
) -> Iterator[tuple[str, np.ndarray]]:
    for i, axis in enumerate(axes):
        if (n := row.shape[1 + i]) > 2:
            ahead, behind = np.take(row, range(1, n), 1 + i), np.take(row, range(n - 1), 1 + i)
            yield f"dependence along {axis}", ahead * behind
    if 1 < row.shape[-1] <= _OUTPUTS and row.ndim > 2:
        pairs = [row[..., a] * row[..., b] for a, b in itertools.combinations(range(row.shape[-1]), 2)]
        yield f"dependence from {axes[-1]} to {axes[-1]}", np.stack(pairs, axis=-1)
    for name, other in others.items():
        if other.shape == row.shape:
            yield f"dependence on {name}", row * other


def skewness(row: np.ndarray) -> np.ndarray:
    """An odd function of a standard normal variable, bounded but for what is linear in it."""
    return math.sqrt(12.0) * (ndtr(row) - 0.5) - _ODD * row


def tails(row: np.ndarray) -> np.ndarray:
    """An even function of a standard normal variable, uncorrelated with its square; negative where tails are heavy."""
    u = ndtr(row)
    return math.sqrt(5.0) * (6 * u * (u - 1) + 1) - _EVEN * (row**2 - 1.0) / math.sqrt(2.0)
