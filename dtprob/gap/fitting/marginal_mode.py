"""The mode of the density from which states, or what each cluster has of its own, are integrated out.

Integrated out by Laplace's method the unknowns of cluster c add V_c = -1/2 log |H_c| to the log density, H_c their
curvature. About its mode V_c is expanded to second order in all else that is fitted, the base model's shared unknowns and
the parameters of mean effects (Tierney and Kadane 1986; Rue, Martino and Chopin 2009, section 3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final, NamedTuple, final

import numpy as np
from jaxtyping import Float, Int

from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.density import terms_of
from dtprob.gap.fitting.fit import Fit, fit
from dtprob.gap.fitting.marginal import following, own_mode
from dtprob.gap.fitting.newton import System
from dtprob.gap.fitting.plausible import nulls, scales, sides
from dtprob.gap.fitting.states import held, states, states_following, states_mode
from dtprob.gap.model.problem import Problem
from dtprob.gap.model.volume import Volume

_ROUNDS: Final = 10
_SHARES: Final = (1.0, 0.5, 0.25, 0.1, 0.03)
_ARRIVED: Final = 0.01
"""Nats by which a round has to be better."""
_UNDERWAY: Final = 1.0
"""Nats by which a round was better if the next one's point is hardly the mode: how the volume bends is kept there."""
_FAR: Final = 1.0
"""Standard deviations of the prior that a coordinate moves in the first round at most."""
_FARTHER: Final = 4.0
"""Times as far in the next round, where a whole move was a gain."""
_STEP: Final = 0.1
"""Of the differences, in standard deviations of a coordinate's prior."""
_NARROW: Final = 0.5
"""The same in those of its posterior beside the unknowns that are integrated out, at most."""
_DENSE: Final = 12
"""Shared coordinates up to which second differences between two of them are taken too."""
_SLIGHT: Final = 0.01
_FLAT: Final = 1e-4
"""Nats by which the volume bends along a coordinate, over its posterior, below which it is not looked at with others; and
beside states those by which it changes over a step."""
_EXACT: Final = 1e-7
_ROUGH: Final = 1e-5
"""Nats that a step to the mode of what is integrated out may promise per cluster, at the end and underway."""
_FAITHFUL: Final = 0.5
"""Nats that the expansion may be off at a fit."""


class Mode(NamedTuple):
    """Of the marginal density: where, its logarithm, the expansion there, and whether the last round gained nothing."""

    x: np.ndarray
    height: float
    volume: Volume
    arrived: bool


@dataclass(frozen=True)
class Around:
    """What is fitted while the rest is integrated out.

    Attributes:
        effects: mean effects that are free.
        index: positions of the coordinates.
        scale: standard deviations of their priors.
        lowest: values that they cannot go below.
    """

    effects: tuple[str, ...]
    index: Int[np.ndarray, " shared"]
    scale: Float[np.ndarray, " shared"]
    lowest: Float[np.ndarray, " shared"]


def around(problem: Problem, names: Sequence[str] = ()) -> Around:
    """The base model's shared unknowns, and after them the parameters of mean effects."""
    index = [held(problem)]
    scale = [np.maximum(problem.prior_spread.deviation[index[0]], 1e-12)]
    lowest = [np.full(len(index[0]), -np.inf)]
    for effect in (e for e in problem.live if e.name in names):
        index.append(problem.layout.of(effect))
        scale.append(scales(effect))
        lowest.append(np.where(sides(effect), nulls(effect), -np.inf))
    return Around(tuple(names), *(np.concatenate(part) for part in (index, scale, lowest)))


def faithful(problem: Problem, fitted: Fit, starts: Sequence[np.ndarray]) -> Fit:
    """A fit with mean effects, or where the expansion does not hold there the mode that is found by expanding again.

    Args:
        problem: in which the effects are live.
        fitted: with the volume of the problem.
        starts: flat vectors from which a search for the mode may start.
    """
    kinds = {e.name: e.kind for e in problem.live}
    if problem.volume is None or any(kinds[name] == "variance" for name in fitted.effects):
        return fitted
    free = around(problem, fitted.effects)
    reached = height_at(problem, fitted.x, free)
    if abs(reached[1] - fitted.log_posterior) < _FAITHFUL:
        return fitted
    here, height = max((reached, *(height_at(problem, x, free) for x in starts)), key=lambda found: found[1])
    mode = about_the_mode(problem, here, height, free)
    return fitted_at(problem, mode, free)


def fitted_at(
    problem: Problem, mode: Mode, free: Around, freed: Callable[[Problem, Fit], Fit] = lambda _, found: found
) -> Fit:
    """The fit at a mode, with the expansion there.

    Args:
        problem: in which the effects are live.
        mode: of the marginal density.
        free: what is fitted.
        freed: frees a fit from local optima; what leads off the mode is not taken.
    """
    whole = problem.with_volume(mode.volume)
    found = freed(whole, fit(whole, mode.x, free.effects))
    if height_at(problem, found.x, free)[1] < mode.height - _ARRIVED:
        found = replace(fit(whole, mode.x, free.effects, steps=0), converged=mode.arrived)
    return replace(found, volume=mode.volume)


def about_the_mode(problem: Problem, here: np.ndarray, height: float, free: Around) -> Mode:
    """The mode of the marginal density, from a point and the log density there."""
    reach, near = _FAR, None
    for _ in range(_ROUNDS):
        volume = _expanded(problem, here, free) if near is None else _sloped(problem, here, free, near)
        move = (fit(problem.with_volume(volume), here, free.effects).x - here)[free.index]
        # each by itself: one that runs away does not hold the others
        move = np.clip(move, -reach * free.scale, reach * free.scale)
        best, highest = here, height
        for share in _SHARES:
            trial = here.copy()
            trial[free.index] += share * move
            trial, value = height_at(problem, trial, free)
            if value > height:
                best, highest, reach = trial, value, reach * _FARTHER if share == 1.0 else _FAR
                break
        if highest - height < _ARRIVED and near is None:
            return Mode(here, height, volume, arrived=True)
        near = volume if highest - height > _UNDERWAY else None
        here, height = best, highest
    return Mode(here, height, _expanded(problem, here, free), arrived=False)


def height_at(problem: Problem, x: np.ndarray, free: Around) -> tuple[np.ndarray, float]:
    """The point with what is integrated out at its mode, and the log density without it."""
    x, volume = _inner(problem, x)
    total = float(terms_of(problem, activate(problem, free.effects), x).sum()) + float(volume.sum())
    return x, total if np.isfinite(total) else -np.inf


def _inner(
    problem: Problem, x: np.ndarray, tolerance: float = 1e-3, *, near: System | None = None
) -> tuple[np.ndarray, Float[np.ndarray, " cluster"]]:
    """The point with what is integrated out, states or the clusters' own unknowns, at its mode, and V_c there."""
    bare = problem.with_volume(None)
    shared_states = states(bare)
    if shared_states.blocks:
        return states_mode(bare, shared_states, x, tolerance=tolerance)
    x, local = own_mode(bare, activate(bare), x, tolerance=tolerance, near=near)
    return x, -0.5 * np.linalg.slogdet(local)[1]


@final
class _Volumes:
    """V_c (cluster,) where fitted coordinates are moved from a point, what is integrated out following.

    Args:
        problem: whose volume it is.
        x: the point.
        free: what is fitted.
        tolerance: see `own_mode`.
    """

    def __init__(self, problem: Problem, x: np.ndarray, free: Around, tolerance: float = _EXACT) -> None:
        self._problem, self._tolerance = problem, tolerance
        there, self.here = _inner(problem, x, tolerance)
        self._follow = _following(problem.with_volume(None), there, free)

    def __call__(self, move: Float[np.ndarray, " shared"]) -> Float[np.ndarray, " cluster"]:
        there, near = self._follow(move)
        return _inner(self._problem, there, self._tolerance, near=near)[1]

    def along(self, step: Float[np.ndarray, " shared"]) -> Float[np.ndarray, "cluster shared"]:
        """V_c a step along each coordinate."""
        return np.stack([self(unit) for unit in np.diag(step)], axis=1)


def _following(
    problem: Problem, x: np.ndarray, free: Around
) -> Callable[[np.ndarray], tuple[np.ndarray, System | None]]:
    """Where a move of the fitted coordinates leads, what is integrated out following; clusters' own system if alone."""
    if states(problem).blocks:
        whole = states_following(problem, x, free.index)
        return lambda move: (x + whole @ move, None)
    system, along = following(problem, x, free.effects, free.index)
    own = activate(problem).local_index

    def moved(move: np.ndarray) -> tuple[np.ndarray, System | None]:
        there = x.copy()
        there[free.index] += move
        there[own] += along @ move
        return there, system

    return moved


def steps(free: Around, joint: Fit) -> Float[np.ndarray, " shared"]:
    """How far apart differences of the volume are taken, so that the unknowns that are integrated out hardly turn.

    Args:
        free: what is fitted.
        joint: a fit of it with what is integrated out.
    """
    place = np.searchsorted(joint.global_index, free.index)
    return np.minimum(_STEP * free.scale, _NARROW * np.sqrt(np.diag(joint.covariance)[place]))


def beside(problem: Problem, x: np.ndarray, free: Around, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """V_c (cluster, shared) a step up and a step down each fitted coordinate."""
    volumes = _Volumes(problem, x, free)
    return volumes.along(step), volumes.along(-step)


def _expanded(problem: Problem, x: np.ndarray, free: Around) -> Volume:
    """V_c about a point, by central differences; what curves upwards is taken as straight.

    Where a step down would lead below what a coordinate can be, the point about which it is looked at is a step above.
    """
    joint = fit(problem.with_volume(None), x, free.effects, steps=0)
    step, at = steps(free, joint), x.copy()
    at[free.index] = np.maximum(x[free.index], free.lowest + step)
    n, units = len(step), np.diag(step)
    volumes = _Volumes(problem, at, free)
    middle, up, down = volumes.here, volumes.along(step), volumes.along(-step)
    slope = (up - down) / 2
    bend = (up + down - 2 * middle[:, None])[:, :, None] * np.eye(n)
    ways = (up - middle[:, None], down - middle[:, None])
    for i, j in combinations(_bent(problem, joint, free, step, ways) if n <= _DENSE else (), 2):
        both = sum(volumes(sign * (units[i] + units[j])) for sign in (1.0, -1.0))
        bend[:, i, j] = bend[:, j, i] = both / 2 - middle - (bend[:, i, i] + bend[:, j, j]) / 2
    value, slope, bend = (np.nan_to_num(part, posinf=0.0, neginf=0.0) for part in (middle, slope, bend))
    values, vectors = np.linalg.eigh(bend)
    bend = np.einsum("cij,cj,ckj->cik", vectors, np.minimum(values, 0.0), vectors)
    return Volume(free.index, at[free.index], value, slope / step, bend / np.outer(step, step))


def _sloped(problem: Problem, x: np.ndarray, free: Around, near: Volume) -> Volume:
    """V_c about a point on the way to the mode, by differences to one side; it bends as at the point of another volume."""
    joint = fit(problem.with_volume(None), x, free.effects, steps=0)
    step = steps(free, joint)
    volumes = _Volumes(problem, x, free, _ROUGH)
    slope = (volumes.along(step) - volumes.here[:, None]) / step
    slope -= np.einsum("cii->ci", near.bend) * step / 2
    value, slope = (np.nan_to_num(part, posinf=0.0, neginf=0.0) for part in (volumes.here, slope))
    return Volume(free.index, x[free.index], value, slope, near.bend)


def _bent(
    problem: Problem, joint: Fit, free: Around, step: np.ndarray, ways: tuple[np.ndarray, np.ndarray]
) -> list[int]:
    """The fitted coordinates along which the volume bends enough to matter; beside states all that change it at all.

    Two that bend by a and b nats over their posteriors bend together by no more than the root of a b, where the volume
    bends one way in all directions.

    Args:
        problem: whose volume it is.
        joint: a fit with what is integrated out.
        free: what is fitted.
        step: along each coordinate (shared,).
        ways: how much V_c (cluster, shared) changes a step up and a step down.
    """
    if len(free.index) < 2:
        return []
    up, down = (np.nan_to_num(way, posinf=0.0, neginf=0.0) for way in ways)
    if states(problem).blocks:
        return [int(i) for i in np.flatnonzero((np.abs(up) + np.abs(down)).sum(axis=0) > _FLAT)]
    place = np.searchsorted(joint.global_index, free.index)
    bend = np.abs(up + down).sum(axis=0) / step**2
    return [int(i) for i in np.flatnonzero(bend * np.diag(joint.covariance)[place] > _SLIGHT)]
