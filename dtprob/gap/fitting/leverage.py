"""What fitting each cluster's own unknowns does to scores: data sets drawn at the fit are not refitted, and lack it.

At the mode of a cluster's own unknowns the residual of reading i has the variance 1 - h_i, h_i its leverage, so rows that
tell of spreads are too low on average, most where a cluster has few readings. And where own unknowns act through a curved
function (a level within an exponential), the score of a site at their mode is not zero on average: own unknowns that are
large and readings that are high go together. Both are the slope of V_c = -1/2 log |H_c|, H_c the curvature of a
cluster's own unknowns, which integrating them out by Laplace's method adds to its log density: with it the score is that
of the integrated likelihood, whose mean is zero (Tierney and Kadane 1986).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting.active import Active, activate, own_basis
from dtprob.gap.fitting.centred import Centred, per_unit
from dtprob.gap.fitting.columns import rows_of_each, scores, scores_of_each
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.projection import Projection
from dtprob.gap.model.bend import Bend
from dtprob.gap.model.problem import Problem

_STEP: Final = 0.1
"""Of differences, in standard deviations of an own unknown's prior."""
DOUBT: Final = 0.1
"""Share of what is added to scores by which it may be off, since it is of first order in 1 / readings."""


class Slopes(NamedTuple):
    """Slopes of a score at sites, (*site) by name, and the flat vector at which an effect's change of these is taken."""

    x: Float[np.ndarray, " dimension"]
    sites: Mapping[str, np.ndarray]


class Leverage(NamedTuple):
    """What is to be added to scores of data at a fit.

    Attributes:
        lost: to residuals (cluster, row).
        moved: to rows (cluster, row) once they are projected: how far the fit is from that of the integrated likelihood.
        sites: to the gradients at sites that these rows give: the slope of V, and the mean of squares.
    """

    lost: Float[np.ndarray, "cluster row"]
    moved: Float[np.ndarray, "cluster row"]
    sites: tuple[Slopes, ...] = ()


def leverage(problem: Problem, fitted: Fit, projection: Projection) -> Leverage:
    """The slope of V along rows, along all that was fitted, and along sites.

    Args:
        problem: the model on its data.
        fitted: the fit.
        projection: there.
    """
    own = projection.local_columns
    nothing = np.zeros(own.shape[:2])
    if not own.shape[-1]:
        return Leverage(nothing, nothing)
    active = activate(problem, fitted.effects, spread=fitted.spread)
    weights, along = own @ projection.local_inverse, own_basis(problem, active)
    bend = problem.compiled.bend(fitted.x, weights, along)
    lost = _stacked(problem, bend.rows)
    if not np.isfinite(lost).all():
        return Leverage(nothing, nothing)
    centre, informed = projection.centre, projection.own.spread > 0
    if centre is None:
        return Leverage(lost, nothing)
    if not informed.all():
        weights *= informed[:, None]
        bend = problem.compiled.bend(fitted.x, weights, along)
    found = _curved(problem, fitted, projection, active, centre, bend=bend, weights=weights)
    return Leverage(lost, nothing) if found is None else Leverage(lost, *found)


def _curved(
    problem: Problem,
    fitted: Fit,
    projection: Projection,
    active: Active,
    centre: Centred,
    *,
    bend: Bend,
    weights: np.ndarray,
) -> tuple[np.ndarray, tuple[Slopes, ...]] | None:
    """How far the fit moves and the slopes at sites, by own unknowns of which a prior tells; None if one is not finite."""
    lost = _stacked(problem, bend.rows)
    told = problem.compiled.site_gradient(fitted.x, lost[None])
    slope = -np.asarray(bend.x)
    sites = [
        Slopes(fitted.x, {n: -np.asarray(g) - np.asarray(told[n])[0] for n, g in bend.sites.items()}),
        *_of_moving_tangents(problem, fitted, active, weights, projection.own.spread),
        *_of_squares(problem, projection, active, centre.x),
    ]
    if not all(np.isfinite(part).all() for part in (slope, *(g for at in sites for g in at.sites.values()))):
        return None
    of_shared = slope[active.global_index] - scores(projection.columns, lost)
    of_own = slope[active.local_index] - scores_of_each(projection.local_columns, lost)
    return -projection.moved(of_shared, of_own), tuple(sites)


def _of_moving_tangents(
    problem: Problem, fitted: Fit, active: Active, weights: np.ndarray, spread: np.ndarray
) -> Iterator[Slopes]:
    """The slope of V by an effect whose change of a site moves with own unknowns; where it does not, these are nothing."""
    for k in range(spread.shape[1]):
        step = _STEP * spread[:, k]
        rows = weights[:, :, k] / (2 * np.where(step > 0, step, np.inf))[:, None]
        at = problem.compiled.site_gradient(fitted.x, rows[None])
        for sign in (1.0, -1.0):
            x = fitted.x.copy()
            x[active.local_index[:, k]] += sign * step
            yield Slopes(x, {name: -sign * np.asarray(g)[0] for name, g in at.items()})


def _of_squares(
    problem: Problem, projection: Projection, active: Active, centre: np.ndarray
) -> Iterator[Slopes]:
    """The mean of what taking scores to the centre of own unknowns' prior changes; see `dtprob.gap.fitting.centred`.

    With W the tangents of a cluster's own unknowns, the part of a site's score that goes with them is b' S, S the slope of
    their log likelihood at the mode and b = (W' W)^-1 W' J with the site's tangents J. S = P a, of a deviation a from the
    prior's centre, P the prior's precision; over clusters a a' P is 1 - H^-1 P on average, H = W' W + P.
    """
    spread, along = projection.own.spread, own_basis(problem, active)
    precision = np.where(spread > 0, np.where(spread > 0, spread, 1.0) ** -2.0, 0.0)
    together = np.eye(spread.shape[1]) - projection.local_inverse * precision[:, None, :]
    for k in range(spread.shape[1]):
        step = _STEP * spread[:, k]
        own = together[:, k] / (2 * np.where(step > 0, step, np.inf))[:, None]
        for sign in (1.0, -1.0):
            x = centre.copy()
            x[active.local_index[:, k]] += sign * step
            unit = per_unit(np.asarray(problem.compiled.linearised(x, along)[1]))
            at = problem.compiled.site_gradient(x, sign * rows_of_each(unit, own)[None])
            yield Slopes(x, {name: np.asarray(g)[0] for name, g in at.items()})


def _stacked(problem: Problem, steps: Mapping[str, jax.Array]) -> Float[np.ndarray, "cluster row"]:
    """Slopes of V, of those in steps of the first location and the first spread row of each observation, at these rows."""
    rows = {}
    for name, slopes in steps.items():
        location, spread = -np.asarray(slopes)
        own, located = np.zeros((problem.components[name], *location.shape)), problem.located[name]
        own[0] = location
        if located < len(own):
            own[located] = spread
        rows[name] = jnp.asarray(own)
    return np.asarray(problem.rows.stack(rows))
