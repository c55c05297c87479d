"""What neither mean nor spread tells of observations: their skewness, tails and evenness, and what goes together.

Rows of a right twin are independent of each other, and normal where the observation is. Dependence is the product of two
rows; skewness and tails are functions of a normal score that no small change of its mean or scale moves (Neyman's smooth
tests with fitted parameters: Thomas and Pierce, JASA 74 (1979)), pooled over enough readings for far ones to be a few
among many. What has no spread of its own, counts and waits, may be spread less than its mean says. Complex rows have a
product with the conjugate, and their square where noise is not circular (Picinbono, IEEE Trans. Signal Process. 42 (1994)).
All are bounded: one far row of a right twin must not look like more. What each is of a right twin, replicates tell.
Tails of what is normal are looked at twice, since a few readings that lie far out are hardly seen among many if they count
for no more than 2.5 standard deviations: held at six, all but the farthest one.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Final

import jax.numpy as jnp
import numpy as np
from scipy.special import ndtri

from dtprob.gap.model.problem import Problem
from dtprob.gap.observation.likelihoods import Likelihood, likelihood
from dtprob.gap.observation.residuals import Parameters
from dtprob.gap.where.bounded import beside, complex_tails, dispersion, few, scored, skewness, tails
from dtprob.gap.where.families import Family, Pattern

_MOST: Final = 1 << 16
"""Entries of an observation up to which it is looked at."""
_HEAVIEST: Final = 4.0
"""Kurtosis over replicates up to which a sum of products of outcomes is looked at; 3 of a normal one."""
_TOLD: Final = 3.3
"""The same, told by the rows' own kurtosis and the number of products."""
_FEW: Final = "few"
"""Label of the tails that a few readings make, wherever they are."""
_LEAST: Final = 1e-12
"""Probabilities are kept so far from zero and one."""
_OF_FAR_ONES: Final = ("skewness", "tails", "dispersion")
"""What the readings that are far out mostly tell."""
_POOLED: Final = 24
"""Readings that these are pooled over, at least: so many have sums that are nearly normal."""
_NOTHING: Final = 1e-12
"""Variance of what does not count."""
_FREE: Final = 0.9
"""Share of their variance that unknowns leave to readings that are not normal, at least, for their shape to be looked at:
states of their own make counts even, and by more than a linear fit tells."""
_OUTPUTS: Final = 8
"""Entries of a last axis up to which each pair is looked at."""
_LATEST: Final = 4
"""Positions by which what goes together may be apart, at most."""
_LONG: Final = 8
"""Positions of an axis from which on that is looked at."""
_MOST_PAIRS: Final = 4096
"""Pairs of components and outputs up to which each is."""


def further_moments(
    problem: Problem, x: np.ndarray, rows: np.ndarray
) -> Iterator[tuple[str, Family, np.ndarray]]:
    """Each observation, what of it is looked at, how that is pooled, and its scores (n, entry).

    Args:
        problem: the model and candidates on their data.
        x: the fit.
        rows: projected ones (n, cluster, row), of the data first.
    """
    families = {name: likelihood(family) for name, family in problem.families.items()}
    every, observations = problem.rows.by_site(rows), problem.compiled.observations(x)
    looked = {
        name: own[:, :1] + 1j * own[:, 1:2] if families[name].is_complex else own[:, : problem.located[name]]
        for name, own in every.items()
        if own[0].size <= _MOST
        if families[name].is_complex or problem.located[name] == 1 or families[name].is_outcome
    }
    products = {
        name: row
        if families[name].is_outcome
        else scored(row, is_normal=families[name].log_scale is not None)
        for name, row in looked.items()
    }
    for name, row in looked.items():
        axes, known = problem.declaration.observed[name].axes, families[name]
        others = {
            n: r for n, r in products.items() if n > name and problem.declaration.observed[n].axes == axes
        }
        shape = _shape(known, observations[name].parameters, row[:, 0], every[name])
        for kind, values in itertools.chain(shape, _dependence(products[name], axes, others)):
            for kept in _kept(values.shape[1:], _POOLED if kind in _OF_FAR_ONES else 1):
                scores = _pooled(values, kept)
                if kind == "dispersion":  # what is spread more shows where values are, entry by entry
                    scores[0] = np.minimum(scores[0], 0.0)
                if not known.is_outcome or _is_near_normal(scores[1:]):
                    pattern = Pattern(axes[kept[0]] if kept else "common", kept)
                    yield name, Family(kind, pattern, np.ones(())), scores
        if known.log_scale is not None and row[0, 0].size >= _POOLED:
            yield name, Family("tails", Pattern(_FEW, ()), np.ones(())), _but_farthest(few(row[:, 0]))
        for kind, scores in _delayed(products[name], axes, is_outcome=known.is_outcome):
            yield name, Family(kind, Pattern("each", ()), np.ones(())), scores


def _kept(shape: tuple[int, ...], least: int) -> Iterator[tuple[int, ...]]:
    """No axis, or one, that leaves at least so many entries to be pooled."""
    wide = [()] + [(i,) for i, n in enumerate(shape) if n > 1]
    return (kept for kept in wide if math.prod(shape) >= least * math.prod(shape[i] for i in kept))


def _pooled(values: np.ndarray, kept: tuple[int, ...]) -> np.ndarray:
    """Values (n, *entry) less what replicates have at the mean, summed over all axes but those kept; both parts of each."""
    centred = values - values[1:].mean(axis=0)
    rest = tuple(1 + i for i in range(values.ndim - 1) if i not in kept)
    return np.ascontiguousarray(centred.sum(rest).reshape(len(values), -1)).view(float)


def _but_farthest(values: np.ndarray) -> np.ndarray:
    """Sums (n, 1) of values (n, *entry) but the largest of each, less what replicates have: one far reading is no tail."""
    each = values.reshape(len(values), -1)
    summed = each.sum(axis=1) - each.max(axis=1)
    scores = (summed - summed[1:].mean())[:, None]
    scores[0] = np.maximum(scores[0], 0.0)  # tails that are too light are none of a few readings
    return scores


def _is_near_normal(scores: np.ndarray) -> bool:
    """Whether sums of rare coincidences vary over replicates (n, entry) as sums of many do, for all entries."""
    square = np.maximum((scores**2).mean(axis=0), 1e-300)
    return bool(np.all((scores**4).mean(axis=0) < _HEAVIEST * square**2))


def _shape(
    known: Likelihood, parameters: Parameters, row: np.ndarray, every: np.ndarray
) -> Iterator[tuple[str, np.ndarray]]:
    """Of first rows (n, *entry); where they are not normal, beside what all rows (n, component, *entry) tell."""
    if np.iscomplexobj(row):
        yield "circularity", scored(row, is_normal=True) ** 2
        yield "tails", complex_tails(row)
    elif known.log_scale is not None:
        yield "skewness", skewness(row)
        yield "tails", tails(row)
    elif known.probability is not None and _freedom(row[1:]) > _FREE:
        smaller = known.probability(parameters, jnp.asarray(np.moveaxis(every, 1, 0)))
        chance = np.nan_to_num(np.asarray(smaller, float), nan=0.5)  # what is masked may have no parameters
        score = ndtri(np.clip(chance, _LEAST, 1 - _LEAST))
        told = scored(every, is_normal=False)
        yield "skewness", beside(skewness(score), told)
        yield "tails", beside(tails(score), told)
        if known.located is None:
            yield "dispersion", beside(dispersion(score), told)


def _freedom(rows: np.ndarray) -> float:
    """Share of their variance that rows (replicate, *entry) keep, on average over the entries that count."""
    variance = (rows**2).mean(axis=0)
    counts = variance > _NOTHING
    return float(variance[counts].mean()) if counts.any() else 0.0


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


def _delayed(row: np.ndarray, axes: tuple[str, ...], *, is_outcome: bool) -> Iterator[tuple[str, np.ndarray]]:
    """Sums (n, entry) of the products of rows (n, component, *entry) with those some positions before on an axis.

    Each component and entry of a short last axis with each; real rows only. Of outcomes those are left out that are too
    rare for sums of their products to vary as sums of many do, as their own tails say: of data and replicates together.
    """
    if np.iscomplexobj(row):
        return
    has_outputs = row.ndim > 3 and 1 < row.shape[-1] <= _OUTPUTS
    several = row if has_outputs else row[..., None]
    if (several.shape[1] * several.shape[-1]) ** 2 > _MOST_PAIRS:
        return
    tail = _kurtosis(several)
    for i, axis in enumerate(axes[:-1] if has_outputs else axes):
        n, along = row.shape[2 + i], np.moveaxis(several, 2 + i, 2)
        for lag in range(1 if has_outputs else 2, _LATEST + 1 if n >= _LONG else 0):
            later, sooner = along[:, :, lag:], along[:, :, :-lag]
            scores = _coincidences(later, sooner)
            terms = later[0, 0, ..., 0].size
            steady = 3 + (np.outer(tail, tail).reshape(-1) - 3) / terms < _TOLD
            scores = (scores - scores[1:].mean(axis=0)) * (steady if is_outcome else 1.0)
            before = "the one" if lag == 1 else f"those {lag}"
            yield f"dependence on {before} before along {axis}", scores


def _coincidences(later: np.ndarray, sooner: np.ndarray) -> np.ndarray:
    """Sums (n, entry) of products of rows (n, component, *position, output), for each pair of components and outputs."""
    n, parts, last = len(later), later.shape[1], later.shape[-1]
    one, other = (
        r.reshape(n, parts, -1, last).swapaxes(2, 3).reshape(n, parts * last, -1) for r in (later, sooner)
    )
    return (one @ other.swapaxes(1, 2)).reshape(n, -1)


def _kurtosis(row: np.ndarray) -> np.ndarray:
    """Of each component and output of rows (n, component, *position, output), over all else."""
    each = np.moveaxis(row, 1, -2).reshape(-1, row.shape[1] * row.shape[-1])
    return (each**4).mean(axis=0) / np.maximum((each**2).mean(axis=0) ** 2, 1e-300)


def _product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return (one * other.conj()).sum(1)
