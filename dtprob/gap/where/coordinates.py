"""Misfit over the data's coordinates: blocks of each axis that hold more of it than the model allows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from dtprob.gap.fitting.bootstrap import Replicates
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation.likelihoods import likelihood
from dtprob.gap.tails import LOG_SMALLEST, beyond_largest, gamma_log_tail, gamma_tail

LEVEL: Final = 0.01
"""Family-wise, of everything that is told of parts of the data."""

_NEARLY_ALL: Final = 0.95
"""Share of a block's excess from which a shorter one in it is told in its place."""


@dataclass(frozen=True)
class CoordinateFinding:
    """A block of coordinates that holds more misfit than the model allows.

    Attributes:
        axis: the data axis.
        low, high: first and last position of the block.
        p_value: family-wise over all blocks of all axes.
        excess: whitened energy above its expectation, in nats.
        parts: first and last position of each block, where several are told together.
    """

    axis: str
    low: int
    high: int
    p_value: float
    excess: float
    parts: tuple[tuple[int, int], ...] = ()


def scan_coordinates(
    problem: Problem, drawn: Replicates
) -> tuple[tuple[CoordinateFinding, ...], dict[str, np.ndarray]]:
    """Energy of the whitened residuals over dyadic blocks of every axis, against its bootstrap distribution.

    Blocks of one length are told from the most that chance makes of any of them, which the replicates show, and the lengths
    share the level: where readings are skew one of them strays farther than a block, and would hide it.

    Returns the blocks that stand out, family-wise at 1%, and for each axis the energy at its positions as a normal
    score (squares of few rows are far from normal), NaN where nothing is observed.
    """
    found, maps, tests = [], {}, 0
    located = problem.rows.is_location
    seen_as_outcomes = any(likelihood(family).is_outcome for family in problem.families.values())
    for axis, position in problem.rows.coordinates.items():
        index = np.where(located, problem.rows.by_cluster(position), -1)
        size = int(index.max()) + 1
        if size < 2:
            continue
        energy = np.stack([_energy(rows, index, size) for rows in drawn.rows])
        mean, variance = energy[1:].mean(0), energy[1:].var(0)
        maps[axis] = np.where(variance > 0, gamma_tail(energy[:1], mean, variance)[1][0], np.nan)
        cumulative = np.concatenate([np.zeros((len(energy), 1)), np.cumsum(energy, axis=1)], axis=1)
        for low, high in _windows(size, ordered=axis != problem.declaration.cluster):
            inside = cumulative[:, high + 1] - cumulative[:, low]
            log_p = _log_p(inside)
            if seen_as_outcomes:
                log_p = np.maximum(log_p, _one_event(drawn.rows, index, inside, low, high))
            root = np.sqrt(-log_p)  # energies of skew readings have tails of roots
            p = beyond_largest(root[0], root[1:].max(axis=1))
            excess = (inside[0] - inside[1:].mean(0)) / 2
            found += _found(axis, low, high, p, excess)
            tests += 1
    adjusted = [replace(block, p_value=tests * block.p_value) for block in found]
    return _without_overlap([block for block in adjusted if block.p_value < LEVEL]), maps


def _found(
    axis: str, low: np.ndarray, high: np.ndarray, p: np.ndarray, excess: np.ndarray
) -> list[CoordinateFinding]:
    return [
        CoordinateFinding(axis, int(low[i]), int(high[i]), float(p[i]), float(excess[i]))
        for i in np.flatnonzero(p < LEVEL)
    ]


def _log_p(inside: np.ndarray) -> np.ndarray:
    """Log p-values of the energy (draw, block), each by the moments of the replicates other than itself.

    A replicate that shares in the moments is never as far out as the data may be.
    """
    null, n = inside[1:], len(inside) - 2
    mean = null.mean(0)
    off = null - mean
    square = (off**2).sum(0)
    means = np.concatenate([mean[None], mean - off / n])
    variances = np.concatenate([square[None] / (n + 1), (square - off**2) / n - (off / n) ** 2])
    return np.maximum(gamma_log_tail(inside, means, variances), LOG_SMALLEST)


def _energy(rows: np.ndarray, index: np.ndarray, size: int) -> np.ndarray:
    keep = index >= 0
    return np.bincount(index[keep], weights=(rows[keep] ** 2), minlength=size)


def _one_event(
    rows: np.ndarray, index: np.ndarray, inside: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Log chance that a block (draw, block) holds one outcome as rare as its rarest, if that makes half of its energy.

    A square of mean 1 reaches r^2 with a probability of 1 / r^2 at most (Markov), and an outcome as rare as this does.
    Replicates that never see it know nothing of its chance.
    """
    keep, size = index >= 0, int(index.max()) + 1
    place = index[keep]
    count = np.concatenate([[0], np.cumsum(np.bincount(place, minlength=size))])
    largest = np.zeros((len(rows), size + 1))
    for one, values in zip(largest, rows, strict=True):
        np.maximum.at(one, place, values[keep] ** 2)
    ends = np.stack([low, high + 1], axis=1).reshape(-1)
    rarest = np.maximum.reduceat(largest, ends, axis=1)[:, ::2]
    n = count[high + 1] - count[low]
    chance = np.log(np.maximum(n, 1)) - np.log(np.maximum(rarest, 1e-300))
    return np.where(2 * rarest > inside, np.minimum(chance, 0.0), -np.inf)


def _windows(size: int, *, ordered: bool) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """First and last of single positions; on ordered axes also of half-overlapping blocks of dyadic length, by length."""
    length = 1
    while length < size:
        low = np.arange(0, size - length + 1, max(length // 2, 1))
        yield low, low + length - 1
        length *= 2
        if not ordered:
            return


def _without_overlap(found: list[CoordinateFinding]) -> tuple[CoordinateFinding, ...]:
    """The strongest blocks of each axis, none overlapping a stronger one."""
    kept: list[CoordinateFinding] = []
    for strongest in sorted(found, key=lambda b: (b.p_value, -b.excess / (b.high - b.low + 1))):
        block = _narrowed(strongest, found)
        if all(b.axis != block.axis or b.high < block.low or block.high < b.low for b in kept):
            kept.append(block)
    return tuple(kept[:12])


def _narrowed(block: CoordinateFinding, found: list[CoordinateFinding]) -> CoordinateFinding:
    """The shortest block within one that holds nearly all of its excess: p-values that are hardly 0 tell no length."""
    inside = (b for b in found if b.axis == block.axis and block.low <= b.low and b.high <= block.high)
    return min(
        (b for b in inside if b.excess >= _NEARLY_ALL * block.excess),
        key=lambda b: b.high - b.low,
        default=block,
    )
