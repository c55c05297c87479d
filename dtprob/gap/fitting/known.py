"""What the prior knows of coordinates, as a normal distribution: of fits from its centre, and of its spread."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dtprob.gap.fitting.active import Active
from dtprob.gap.fitting.newton import positive
from dtprob.gap.model.layout import Block
from dtprob.gap.model.problem import Problem

_FAINT: Final = 1e-3
"""Share of the data's information on a coordinate below which its prior's is not looked at."""
_HEAVY: Final = ("StudentT", "Cauchy", "Laplace", "Logistic", "SoftLaplace")
"""Priors with heavier tails than a normal one, drawn about zero."""
_LEVEL: Final = 1e-6
"""Slope of a log prior that is none, and distance from zero, in units of the prior's spread."""
_ALIKE: Final = 0.25
"""Share by which the centre and the spread of a normal distribution differ from those of its draws, at most."""
_NEAR: Final = 0.5
"""Standard deviations from the prior's centre up to which a slope tells nothing of the spread."""
_FARTHEST: Final = 3.0
"""Standard deviations from which draws of the prior tell no longer how far out a point is."""
_ALONE: Final = 1e-6
"""Share of its own curvature beyond which a coordinate's prior depends on another one."""


class Known(NamedTuple):
    """What the prior knows of some coordinates, those of which it knows nothing where they are.

    Attributes:
        deviation: of the fit from the prior's centre (..., coordinate); 0 where the prior knows nothing.
        root: of the prior's covariance (..., coordinate, coordinate); rows are 0 where it knows nothing.
    """

    deviation: np.ndarray
    root: np.ndarray


def secants(
    problem: Problem,
    active: Active,
    x: np.ndarray,
    directions: np.ndarray,
    *,
    slope: np.ndarray,
    hessian: np.ndarray,
    told: Float[np.ndarray, " dimension"],
) -> Float[np.ndarray, " dimension"]:
    """Precision of priors of which the curvature at a point is none, not a number for the others.

    Args:
        problem: the model on its data.
        active: what is free.
        x: the point.
        directions: of the free coordinates (k, dimension).
        slope: of the log prior (dimension,).
        hessian: minus the log prior's curvature times the directions (k, dimension).
        told: information of the data on each coordinate.
    """
    heavy = _heavy_tailed(problem, active, x, directions, slope=slope)
    skewed = _skewed(problem, active, x, slope=slope, hessian=hessian, told=told)
    return np.where(np.isfinite(heavy), heavy, skewed)


def _skewed(
    problem: Problem,
    active: Active,
    x: np.ndarray,
    *,
    slope: np.ndarray,
    hessian: np.ndarray,
    told: np.ndarray,
) -> np.ndarray:
    """Precision (dimension,) of priors that are not normal, of one coordinate, where the curvature puts x too far out.

    The logarithm of a half-normal spread far below its scale has a slope and hardly a curvature: these put it many standard
    deviations from a centre that is nowhere, where one in seven draws is smaller. With the slope held, the precision is
    the one that puts x where it lies among draws; nothing is known where the prior is less curved than most of it.
    """
    found, curvature, alone = np.full(len(x), np.nan), *_own_curvature(active, hessian, len(x))
    known = {name for names in problem.known for name in names}
    base = [b for b in active.blocks if b.owner is None and b.name not in known and not _is_heavy(problem, b)]
    at = np.unique(np.concatenate([b.index.reshape(-1) for b in base])) if base else np.zeros(0, int)
    alone = alone | _tied_within(problem, active, base, x, slope=slope, hessian=hessian)
    at = at[alone[at] & (np.abs(slope[at]) * problem.prior_spread.deviation[at] > _LEVEL)]
    at = at[np.abs(curvature[at]) > _FAINT * told[at]]
    middle, spread = problem.prior_spread.middle[at], problem.prior_spread.deviation[at]
    with np.errstate(divide="ignore", invalid="ignore"):
        here = 1 / np.sqrt(curvature[at])
        centre = x[at] + slope[at] * here**2
        is_normal = np.maximum(np.abs(centre - middle), np.abs(here - spread)) < _ALIKE * spread
    at, here, spread = at[~is_normal], here[~is_normal], spread[~is_normal]
    drawn = np.abs(problem.prior_spread.score(x, at))
    score = np.maximum(drawn, _NEAR)
    is_near = np.abs(slope[at]) * here < (1 + _ALIKE) * score
    wrong = ~is_near & (drawn < _FARTHEST)
    found[at[wrong]] = (slope[at] / score)[wrong] ** 2
    found[at[~is_near & (here > spread)]] = 0.0  # falls off as an exponential does
    return found


def _tied_within(
    problem: Problem,
    active: Active,
    base: Sequence[Block],
    x: np.ndarray,
    *,
    slope: np.ndarray,
    hessian: np.ndarray,
) -> Bool[np.ndarray, " dimension"]:
    """Shared coordinates whose prior depends on others of their own site alone, and is not normal together with them.

    So are the log ratios of a table of chances: that of an outcome which was never seen lies in an exponential tail.
    """
    found, moved = np.zeros(len(x), bool), active.global_index
    for block in base:
        is_own = np.isin(moved, block.index)
        if block.local or is_own.sum() < 2:
            continue
        own, rows = moved[is_own], hessian[: len(moved)][is_own]
        precision, beside = rows[:, own], np.delete(rows, own, axis=1)
        if np.abs(beside).max(initial=0.0) > _ALONE * np.abs(precision).max():
            continue
        centre = x[own] + np.linalg.solve(positive(precision), slope[own])
        middle, spread = problem.prior_spread.middle[own], problem.prior_spread.deviation[own]
        found[own] = (np.abs(centre - middle) > _ALIKE * spread).any()
    return found


def _own_curvature(
    active: Active, hessian: np.ndarray, dimension: int
) -> tuple[Float[np.ndarray, " dimension"], Bool[np.ndarray, " dimension"]]:
    """Minus the log prior's curvature along each coordinate, and whether that coordinate depends on no other."""
    curvature, alone = np.full(dimension, np.nan), np.zeros(dimension, bool)
    moved = [*active.global_index[:, None], *active.local_index.T]
    for row, own in zip(hessian, moved, strict=True):
        beside = np.abs(row)
        beside[own] = 0.0
        curvature[own], alone[own] = row[own], beside.max(initial=0.0) <= _ALONE * np.abs(row[own])
    return curvature, alone


def _is_heavy(problem: Problem, block: Block) -> bool:
    return problem.declaration.sites[block.name].distribution in _HEAVY


def _heavy_tailed(
    problem: Problem, active: Active, x: np.ndarray, directions: np.ndarray, *, slope: np.ndarray
) -> np.ndarray:
    """Precision (dimension,) of heavy-tailed priors about zero, not a number where a prior is of another kind.

    Given its weight, a Student t variable is normal, of the precision that its slope has along the secant to its centre
    (Lange, Little and Taylor, JASA 84 (1989) 881). The curvature at a far one is no precision: it may be negative.
    """
    found = np.full(len(x), np.nan)
    own = [b.index for b in active.blocks if b.owner is None and _is_heavy(problem, b)]
    if not own:
        return found
    index = np.unique(np.concatenate([i.reshape(-1) for i in own]))
    centre = x.copy()
    centre[index] = 0.0
    spread = problem.prior_spread.deviation[index]
    level = np.abs(problem.compiled.prior(centre, directions)[0][index]) * spread < _LEVEL
    away = level & (np.abs(x[index]) > _LEVEL * spread)
    found[index[away]] = -slope[index[away]] / x[index[away]]
    return found


def along_secants(precision: np.ndarray, secant: np.ndarray) -> np.ndarray:
    """Precision (..., i, i) with other entries on its diagonal where these are numbers."""
    told = np.isfinite(secant)
    apart = np.where(told[..., :, None] | told[..., None, :], 0.0, precision)
    return apart + np.where(told, secant, 0.0)[..., None] * np.eye(secant.shape[-1])


def known_of(slope: np.ndarray, precision: np.ndarray, information: np.ndarray) -> Known:
    """From slope (..., i) and precision (..., i, i) of a log prior; what the data know far better is not known before."""
    alone = np.eye(slope.shape[-1])
    informative = np.einsum("...ii->...i", precision) > _FAINT * information
    both = informative[..., :, None] & informative[..., None, :]
    covariance = np.where(both, np.linalg.inv(positive(np.where(both, precision, alone))), 0.0)
    root = np.where(both, np.linalg.cholesky(positive(covariance + ~informative[..., None] * alone)), 0.0)
    return Known(-np.einsum("...ij,...j->...i", covariance, slope), root)
