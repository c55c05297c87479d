"""Where along the data's axes the gap lies that the accepted causes close: the positions that hold most of it.

Misfit spread over many rows hides in their noise, as `coordinates` looks at it. Once a cause is known, the data are looked
at along what it changes: u = <delta, r> over a block, delta being the whitened shift from the base fit to the fit with the
causes and r the projected residuals of the base fit. Where nothing is closed u / |delta| is at most a standard normal.
"""

from __future__ import annotations

from collections.abc import Iterator
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
from dtprob.gap.view import View
from dtprob.gap.where.coordinates import CoordinateFinding

_HELD: Final = 0.9
"""Share of what the causes tell that the positions of an axis hold together."""
_LOCAL: Final = 0.5
"""Share of an axis's positions up to which a cause is at some place of it, and not everywhere."""
_LEVEL: Final = 0.01


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

    @property
    def gain(self) -> float:
        """Nats that the best size of what the causes do here would gain."""
        return self.z**2 / 2


def touched(before: View, after: View) -> tuple[CoordinateFinding, ...]:
    """The blocks that the accepted causes reach, and on all other axes those whose misfit stands out at the base fit.

    Args:
        before: the base fit.
        after: the fit with the accepted effects.
    """
    found = reach(before.problem, before.fitted, before.projection, after.problem, after.fitted)
    axes = {block.axis for block in found}
    return (*found, *(block for block in before.location.coordinates if block.axis not in axes))


def reach(
    problem: Problem, base: Fit, projection: Projection, wider: Problem, fitted: Fit
) -> tuple[CoordinateFinding, ...]:
    """Blocks of every axis that hold what mean effects close, family-wise at 1%; none of an axis they fill.

    Source: Holm 1979 for the step-down p-values.

    Args:
        problem: the model.
        base: its fit.
        projection: at that fit.
        wider: the model with effects live.
        fitted: its fit with some of them; random fields among these are left out.
    """
    delta, rows = _shift(problem, base, wider, fitted), problem.rows
    _, projected = observed_rows(problem, base, projection)
    delta = np.where(rows.by_cluster(rows.located) == 1, delta, 0.0)
    if not np.isfinite(delta).all() or not (delta**2).any():
        return ()
    blocks: list[_Block] = []
    for axis, position in rows.coordinates.items():
        index = rows.by_cluster(position)
        keep = index >= 0
        energy = np.bincount(index[keep], weights=delta[keep] ** 2)
        product = np.bincount(index[keep], weights=(delta * projected)[keep])
        for low, high in _held(energy, together=axis != problem.declaration.cluster):
            place = slice(low, high + 1)
            blocks.append(_Block(axis, low, high, float(product[place].sum()), float(energy[place].sum())))
    blocks.sort(key=lambda block: -block.z)
    step_down = np.maximum.accumulate(
        [float(stats.norm.sf(block.z)) * (len(blocks) - k) for k, block in enumerate(blocks)]
    )
    found = [
        CoordinateFinding(b.axis, b.low, b.high, float(p), b.gain)
        for b, p in zip(blocks, step_down, strict=True)
        if p < _LEVEL
    ]
    return tuple(sorted(found, key=lambda b: -b.excess))


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
