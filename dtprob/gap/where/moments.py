"""What neither mean nor spread tells of observations: their skewness and tails, and what goes together.

Rows of a right twin are independent of each other, and normal where the observation is. Dependence is the product of two
rows; skewness and tails are smooth functions of a normal row that no small change of its mean or scale moves (Neyman's
smooth tests with fitted parameters: Thomas and Pierce, JASA 74 (1979)). Complex rows have a product with the conjugate, and
their square where noise is not circular (Picinbono, IEEE Trans. Signal Process. 42 (1994)). What each is of a right twin,
replicates tell.
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
_HEAVIEST: Final = 4.0
"""Kurtosis over replicates up to which a sum of products of outcomes is looked at; 3 of a normal one."""
_OUTPUTS: Final = 8
"""Entries of a last axis up to which each pair is looked at."""
_ODD: Final = math.sqrt(3.0 / math.pi)
_EVEN: Final = math.sqrt(15.0 / 2.0) / math.pi
"""Covariance of the first two Legendre polynomials of a normal variable's probability with the variable and its square."""
_POWER: Final = math.sqrt(12.0) / 4.0
"""Covariance of the first one, of an exponential variable's probability, with the variable."""

_MOMENTS: Final = ("spread", "skewness", "tails", "circularity", "dependence")
"""First words of kinds that are no change of values."""


def moment(family: str) -> str | None:
    """What of an observation a family of this label moves, if not values: "spread", "dependence along link"."""
    kind = family.partition(",")[0]
    return kind if kind.split(" ")[0] in _MOMENTS else None


def further_moments(problem: Problem, rows: np.ndarray) -> Iterator[tuple[str, Family, np.ndarray]]:
    """Each observation, what of it is looked at, how that is pooled, and its scores (n, entry).

    Args:
        problem: the model and candidates on their data.
        rows: projected ones (n, cluster, row), of the data first.
    """
    looked = {
        name: own[:, :1] + 1j * own[:, 1:2] if is_complex else own[:, : problem.located[name]]
        for name, own in problem.by_observation(rows).items()
        if own[0].size <= _MOST
        if (is_complex := LIKELIHOODS[problem.families[name]].is_complex)
        or problem.located[name] == 1
        or LIKELIHOODS[problem.families[name]].is_outcome
    }
    for name, row in looked.items():
        axes, known = problem.declaration.observed[name].axes, LIKELIHOODS[problem.families[name]]
        others = {
            n: r for n, r in looked.items() if n > name and problem.declaration.observed[n].axes == axes
        }
        shape = _shape(row[:, 0]) if known.log_scale is not None else ()
        for kind, values in (*shape, *_dependence(row, axes, others)):
            for kept in ((), *((i,) for i in range(len(axes)) if values.shape[1 + i] > 1)):
                scores = _pooled(values, kept)
                if not known.is_outcome or _is_near_normal(scores[1:]):
                    pattern = Pattern(axes[kept[0]] if kept else "common", kept)
                    yield name, Family(kind, pattern, np.ones(())), scores


def _pooled(values: np.ndarray, kept: tuple[int, ...]) -> np.ndarray:
    """Values (n, *entry) less what replicates have at the mean, summed over all axes but those kept; both parts of each."""
    centred = values - values[1:].mean(axis=0)
    rest = tuple(1 + i for i in range(values.ndim - 1) if i not in kept)
    return np.ascontiguousarray(centred.sum(rest).reshape(len(values), -1)).view(float)


def _is_near_normal(scores: np.ndarray) -> bool:
    """Whether sums of rare coincidences vary over replicates (n, entry) as sums of many do, for all entries."""
    square = np.maximum((scores**2).mean(axis=0), 1e-300)
    return bool(np.all((scores**4).mean(axis=0) < _HEAVIEST * square**2))


def _shape(row: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    if np.iscomplexobj(row):
        yield "circularity", row**2
        yield "tails", complex_tails(row)
    else:
        yield "skewness", skewness(row)
        yield "tails", tails(row)


def _dependence(
    row: np.ndarray, axes: tuple[str, ...], others: dict[str, np.ndarray]
) -> Iterator[tuple[str, np.ndarray]]:
    """Products of rows (n, component, *entry), summed over the components."""
    last = row.shape[-1] if row.ndim > 3 else 1
    pairs = list(itertools.combinations(range(last), 2)) if last <= _OUTPUTS else []
    for i, axis in enumerate(axes):
        n, is_the_pair = row.shape[2 + i], i == row.ndim - 3 and len(pairs) == 1
        if n > 1 and not is_the_pair:
            ahead, behind = np.take(row, range(1, n), 2 + i), np.take(row, range(n - 1), 2 + i)
            yield f"dependence along {axis}", _product(ahead, behind)
    if pairs:
        together = np.stack([_product(row[..., a], row[..., b]) for a, b in pairs], axis=-1)
        yield f"dependence from {axes[-1]} to {axes[-1]}", together
    for name, other in others.items():
        if other.shape == row.shape:
            yield f"dependence on {name}", _product(row, other)


def _product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return (one * other.conj()).sum(1)


def skewness(row: np.ndarray) -> np.ndarray:
    """An odd function of a standard normal variable, bounded but for what is linear in it."""
    return math.sqrt(12.0) * (ndtr(row) - 0.5) - _ODD * row


def tails(row: np.ndarray) -> np.ndarray:
    """An even function of a standard normal variable, uncorrelated with its square; negative where tails are heavy."""
    u = ndtr(row)
    return math.sqrt(5.0) * (6 * u * (u - 1) + 1) - _EVEN * (row**2 - 1.0) / math.sqrt(2.0)


def complex_tails(row: np.ndarray) -> np.ndarray:
    """A function of the power of a circular normal variable of variance two, uncorrelated with it; negative where heavy."""
    power = np.abs(row) ** 2 / 2.0
    return math.sqrt(12.0) * (0.5 - np.exp(-power)) - _POWER * (power - 1.0)
