"""Misfit over the data's coordinates: blocks of each axis that hold more of it than the model allows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dtprob.gap.fitting.bootstrap import Replicates
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation.likelihoods import likelihood
from dtprob.gap.tails import family_wise, gamma_tail


@dataclass(frozen=True)
class CoordinateFinding:
    """A block of coordinates that holds more misfit than the model allows.

    Attributes:
        axis: the data axis.
        low, high: first and last position of the block.
        p_value: family-wise over all blocks of all axes.
        excess: whitened energy above its expectation, in nats.
    """

    axis: str
    low: int
    high: int
    p_value: float
    excess: float


def scan_coordinates(
    problem: Problem, drawn: Replicates
) -> tuple[tuple[CoordinateFinding, ...], dict[str, np.ndarray]]:
    """Energy of the whitened residuals over dyadic blocks of every axis, against its bootstrap distribution.

    Returns the blocks that stand out, family-wise at 1%, and for each axis the energy at its positions as a normal
    score (squares of few rows are far from normal), NaN where nothing is observed.
    """
    blocks: list[tuple[str, int, int]] = []
    p, excess, maps = [], [], {}
    located = problem.rows.by_cluster(problem.rows.located) == 1
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
        low, high = np.array(list(_windows(size, ordered=axis != problem.declaration.cluster))).T
        inside = cumulative[:, high + 1] - cumulative[:, low]
        blocks += ((axis, *window) for window in zip(low.tolist(), high.tolist(), strict=True))
        tail = gamma_tail(inside, inside[1:].mean(0), inside[1:].var(0))[0]
        if seen_as_outcomes:
            tail[0] = np.maximum(tail[0], _one_event(drawn.rows[0], index, inside[0], low, high))
        p.append(tail)
        excess.append((inside[0] - inside[1:].mean(0)) / 2)
    if not blocks:
        return (), maps
    tails = np.concatenate(p, axis=1)
    adjusted = family_wise(tails[0], tails[1:].min(axis=1))
    found = [
        CoordinateFinding(*block, p_value=float(adjusted[i]), excess=float(e))
        for i, (block, e) in enumerate(zip(blocks, np.concatenate(excess), strict=True))
        if adjusted[i] < 0.01
    ]
    return _without_overlap(found), maps


def _energy(rows: np.ndarray, index: np.ndarray, size: int) -> np.ndarray:
    keep = index >= 0
    return np.bincount(index[keep], weights=(rows[keep] ** 2), minlength=size)


def _one_event(
    rows: np.ndarray, index: np.ndarray, inside: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Chance that a block holds one outcome as rare as its rarest, 0 where that makes less than half of its energy.

    A square of mean 1 reaches r^2 with a probability of 1 / r^2 at most (Markov), and an outcome as rare as this does.
    Replicates that never see it know nothing of its chance.
    """
    place, size = index[index >= 0], int(index.max()) + 1
    largest, count = np.zeros(size), np.concatenate([[0], np.cumsum(np.bincount(place, minlength=size))])
    np.maximum.at(largest, place, rows[index >= 0] ** 2)
    rarest = np.array([largest[a:b].max() for a, b in zip(low.tolist(), (high + 1).tolist(), strict=True)])
    n = count[high + 1] - count[low]
    return np.where(2 * rarest > inside, np.minimum(n / np.maximum(rarest, 1e-300), 1.0), 0.0)


def _windows(size: int, *, ordered: bool) -> Iterator[tuple[int, int]]:
    """Single positions; on ordered axes also half-overlapping blocks of dyadic length below the whole."""
    length = 1
    while length < size:
        for low in range(0, size - length + 1, max(length // 2, 1)):
            yield low, low + length - 1
        length *= 2
        if not ordered:
            return


def _without_overlap(found: list[CoordinateFinding]) -> tuple[CoordinateFinding, ...]:
    """The strongest blocks of each axis, none overlapping a stronger one."""
    kept: list[CoordinateFinding] = []
    for block in sorted(found, key=lambda b: (b.p_value, -b.excess / (b.high - b.low + 1))):
        if all(b.axis != block.axis or b.high < block.low or block.high < b.low for b in kept):
            kept.append(block)
    return tuple(kept[:12])
