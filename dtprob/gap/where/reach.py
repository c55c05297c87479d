"""Where along the data's axes the gap lies that the accepted causes close: the positions that hold most of it.

Misfit spread over many rows hides in their noise, as `coordinates` looks at it. Once a cause is known, the data are looked
at along what it changes: u = <delta, r> over a block, delta being the whitened shift from the base fit to the fit with the
causes and r the projected residuals of the base fit. Where nothing is closed u / |delta| is at most a standard normal.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from dtprob.gap.fitting.active import means_among
from dtprob.gap.fitting.bootstrap import observed_rows
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.projection import Projection
from dtprob.gap.fitting.refit import at_null_except
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation import whiten
from dtprob.gap.where.coordinates import CoordinateFinding

_HELD: Final = 0.9
"""Share of what the causes tell that the positions of an axis hold together."""
_LOCAL: Final = 0.5
"""Share of an axis's positions up to which a cause is at some place of it, and not everywhere."""
_LEVEL: Final = 0.01


class Told(NamedTuple):
    """What each position (position,) of an axis tells of the causes: <delta, r> and <delta, delta>."""

    product: Float[np.ndarray, " position"]
    energy: Float[np.ndarray, " position"]


class _Block(NamedTuple):
    """Positions of an axis, from first to last, and what they hold: <delta, r> and <delta, delta>."""

    axis: str
    low: int
    high: int
    product: float
    energy: float

    @property
    def z(self) -> float:
        """Standard normal where the causes do nothing."""
        return self.product / np.sqrt(self.energy)

    def found(self, p_value: float) -> CoordinateFinding:
        """The block with the nats that the best size of what the causes do here would gain, if they do it at all."""
        return CoordinateFinding(self.axis, self.low, self.high, p_value, max(self.z, 0.0) ** 2 / 2)


def told(problem: Problem, base: Fit, projection: Projection, wider: Problem, fitted: Fit) -> dict[str, Told]:
    """What each position of every axis tells of mean effects; nothing where they shift nothing.

    Args:
        problem: the model.
        base: its fit.
        projection: at that fit.
        wider: the model with effects live.
        fitted: its fit with some of them; random fields among these are left out.
    """
    rows = problem.rows
    delta = np.where(rows.by_cluster(rows.located) == 1, _shift(problem, base, wider, fitted), 0.0)
    if not np.isfinite(delta).all() or not (delta**2).any():
        return {}
    _, projected = observed_rows(problem, base, projection)
    found = {}
    for axis, position in rows.coordinates.items():
        index = rows.by_cluster(position)
        keep = index >= 0
        product = np.bincount(index[keep], weights=(delta * projected)[keep])
        found[axis] = Told(product, np.bincount(index[keep], weights=delta[keep] ** 2))
    return found


def reached(along: Mapping[str, Told], unordered: str | None) -> tuple[CoordinateFinding, ...]:
    """Blocks of every axis that hold what mean effects close, family-wise at 1%; none of an axis they fill.

    Each block is told on its own as far as that goes (Holm 1979). The others of an axis, too weak alone, are told together:
    all of them where what they hold in sum is no chance, with its p-value.

    Args:
        along: what each position tells, by axis.
        unordered: the axis of clusters, whose neighbours make no block.
    """
    blocks = [
        _Block(axis, low, high, *(float(part[low : high + 1].sum()) for part in here))
        for axis, here in along.items()
        for low, high in _held(here.energy, together=axis != unordered)
    ]
    blocks.sort(key=lambda block: -block.z)
    step_down = np.maximum.accumulate(
        [float(stats.norm.sf(block.z)) * (len(blocks) - k) for k, block in enumerate(blocks)]
    )
    found = [block.found(float(p)) for block, p in zip(blocks, step_down, strict=True) if p < _LEVEL]
    weak = blocks[len(found) :]
    for axis in along:
        rest = [block for block in weak if block.axis == axis]
        if len(rest) > 1 and (p := _together(rest) * len(along)) < _LEVEL:
            found += [block.found(p) for block in rest]
    return tuple(sorted(found, key=lambda b: -b.excess))


def _together(blocks: list[_Block]) -> float:
    """Chance that blocks hold as much in sum where the causes do nothing."""
    product, energy = sum(b.product for b in blocks), sum(b.energy for b in blocks)
    return float(stats.norm.sf(product / np.sqrt(energy)))


def _held(energy: Float[np.ndarray, " position"], *, together: bool) -> Iterator[tuple[int, int]]:
    """The fewest positions that hold most of the energy, neighbours together if asked; none if they fill the axis."""
    if energy.sum() <= 0:  # a site along this axis alone that nothing shifts
        return
    order: Int[np.ndarray, " position"] = np.argsort(-energy)
    count = 1 + int(np.searchsorted(np.cumsum(energy[order]), _HELD * energy.sum()))
    if count > _LOCAL * len(energy):
        return
    chosen = np.sort(order[:count])
    runs = np.split(chosen, np.flatnonzero(np.diff(chosen) > 1) + 1) if together else chosen[:, None]
    yield from ((int(run[0]), int(run[-1])) for run in runs)


def _shift(problem: Problem, base: Fit, wider: Problem, fitted: Fit) -> np.ndarray:
    """Whitened shift (cluster, row) of the observed distributions from the base fit to the one with the mean effects."""
    kept = means_among(wider, fitted.effects)
    there = wider.compiled.observations(at_null_except(wider, fitted, kept)) if kept else {}
    shifts = {}
    for name, observed in problem.compiled.observations(base.x).items():
        moved = there.get(name, observed)
        if moved.family != observed.family:
            moved = observed  # another family is no shift
        change = {n: moved.parameters[n] - value for n, value in observed.parameters.items()}
        shifts[name] = whiten.shift(observed, change)
    return np.asarray(problem.rows.stack(shifts))
