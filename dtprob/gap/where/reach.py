"""Where along the data's axes the gap lies that the accepted causes close: the positions that hold most of it.

Misfit spread over many rows hides in their noise, as `coordinates` looks at it. Once a cause is known, the data are looked
at along what it changes: u = <delta, r> over a block, delta being the whitened shift from the base fit to the fit with the
causes, in the size that tells most to first order, and r the projected residuals of the base fit. Where nothing is closed
u / |delta| is a standard normal if the causes have one size, and at most as long as so many of them if they have several.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from dtprob.gap.fitting.active import means_among
from dtprob.gap.fitting.bootstrap import observed_rows
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.projection import Projection
from dtprob.gap.fitting.refit import at_null_except
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation import whiten
from dtprob.gap.observation.whiten import Observation
from dtprob.gap.where.coordinates import LEVEL, CoordinateFinding

_HELD: Final = 0.9
"""Share of what the causes tell that the positions of an axis hold together."""
_LOCAL: Final = 0.5
"""Share of an axis's positions up to which a cause is at some place of it, and not everywhere."""
_ROUNDING: Final = 1e-12
"""Share of the most that any position is changed up to which one is not changed at all."""


class Told(NamedTuple):
    """What each position (position,) of an axis tells of the causes: <delta, r> and <delta, delta>.

    `touched` says where the causes change something themselves, and not only the refitted nuisances.
    """

    product: Float[np.ndarray, " position"]
    energy: Float[np.ndarray, " position"]
    touched: Bool[np.ndarray, " position"]

    @property
    def gain(self) -> Float[np.ndarray, " position"]:
        """Nats that each position gains, to first order."""
        return self.product - self.energy / 2


class _Block(NamedTuple):
    """Positions of an axis, from first to last, and what they hold: <delta, r> and <delta, delta>."""

    axis: str
    low: int
    high: int
    product: float
    energy: float

    @property
    def z(self) -> float:
        """Standard normal where a cause of one size does nothing."""
        return self.product / np.sqrt(self.energy)

    def found(self, p_value: float) -> CoordinateFinding:
        """The block with the nats that it gains."""
        return CoordinateFinding(self.axis, self.low, self.high, p_value, self.product - self.energy / 2)


def told(problem: Problem, base: Fit, projection: Projection, wider: Problem, fitted: Fit) -> dict[str, Told]:
    """What each position of every axis tells of mean effects; nothing where they shift nothing.

    Args:
        problem: the model.
        base: its fit.
        projection: at that fit.
        wider: the model with effects live.
        fitted: its fit with some of them; random fields among these are left out.
    """
    rows, kept = problem.rows, means_among(wider, fitted.effects)
    if not kept:
        return {}
    there = wider.compiled.observations(at_null_except(wider, fitted, kept))
    without = wider.compiled.observations(at_null_except(wider, fitted, ()))
    delta, own = (
        np.where(rows.is_location, _shift(problem, start, there), 0.0)
        for start in (problem.compiled.observations(base.x), without)
    )
    if not np.isfinite(delta + own).all() or not (delta**2).any():
        return {}
    _, projected = observed_rows(problem, base, projection)
    size = float((delta * projected).sum() / (delta**2).sum())  # a large shift is not linear
    if size <= 0:
        return {}
    delta = size * delta
    found = {}
    for axis, position in rows.coordinates.items():
        index = rows.by_cluster(position)
        keep = index >= 0
        product = np.bincount(index[keep], weights=(delta * projected)[keep])
        energy, by_causes = (np.bincount(index[keep], weights=shift[keep] ** 2) for shift in (delta, own))
        found[axis] = Told(product, energy, by_causes > _ROUNDING * by_causes.max())
    return found


def reached(along: Mapping[str, Told], unordered: str | None, sizes: int) -> tuple[CoordinateFinding, ...]:
    """Blocks of every axis that hold what mean effects close, family-wise at 1%; none of an axis they fill.

    Each block is told on its own as far as that goes (Holm 1979). The others of an axis, too weak alone, are told together:
    as one finding of several parts where what they hold in sum is no chance. Where both can be, each has half the level.

    Args:
        along: what each position tells, by axis.
        unordered: the axis of clusters, whose neighbours make no block.
        sizes: how many parameters the effects have, fitted to these data.
    """
    blocks = [
        _Block(axis, low, high, *(float(part[low : high + 1].sum()) for part in (here.product, here.energy)))
        for axis, here in along.items()
        for low, high in _held(np.where(here.touched, here.energy, 0.0), together=axis != unordered)
    ]
    blocks.sort(key=lambda block: -block.z)
    several = len(blocks) > len({block.axis for block in blocks})  # along one axis
    level = LEVEL / 2 if several else LEVEL
    step_down = np.maximum.accumulate(
        [_chance(block.z, sizes) * (len(blocks) - k) for k, block in enumerate(blocks)]
    )
    found = [block.found(float(p)) for block, p in zip(blocks, step_down, strict=True) if p < level]
    weak = blocks[len(found) :]
    for axis in along:
        rest = sorted((block for block in weak if block.axis == axis), key=lambda block: block.low)
        if len(rest) > 1:
            all_of_them = _together(rest)
            if (p := _chance(all_of_them.z, sizes) * len(along)) < level:
                parts = tuple((block.low, block.high) for block in rest)
                found.append(replace(all_of_them.found(p), parts=parts))
    return tuple(sorted(found, key=lambda b: -b.excess))


def _chance(z: float, sizes: int) -> float:
    """That blocks tell as much of causes whose sizes were fitted to them, where these do nothing."""
    return float(stats.chi2.sf(max(z, 0.0) ** 2, sizes))


def _together(blocks: list[_Block]) -> _Block:
    """All of them, from the first to the last, and what they hold."""
    first, last = blocks[0], blocks[-1]
    return _Block(
        first.axis, first.low, last.high, sum(b.product for b in blocks), sum(b.energy for b in blocks)
    )


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


def _shift(
    problem: Problem, start: Mapping[str, Observation], there: Mapping[str, Observation]
) -> Float[np.ndarray, "cluster row"]:
    """Whitened shift of the observed distributions from one point to another."""
    shifts = {}
    for name, observed in start.items():
        moved = there.get(name, observed)
        if moved.family != observed.family:
            moved = observed  # another family is no shift
        change = {n: moved.parameters[n] - value for n, value in observed.parameters.items()}
        shifts[name] = whiten.shift(observed, change)
    return np.asarray(problem.rows.stack(shifts))
