"""What a fit maximises: the log posterior of the free coordinates, its terms by cluster, its scores and curvatures."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting.active import LOG_2PI, Active, basis, effect_prior
from dtprob.gap.fitting.newton import NewtonStep, System
from dtprob.gap.model.problem import Problem

_FARTHEST: Final = 10.0
"""Standard deviations of its prior that an unknown of the base model moves in a step at most."""


def system_at(problem: Problem, active: Active, x: np.ndarray) -> System:
    """What a Gauss-Newton step at x needs: scores and curvatures of the free coordinates."""
    directions = basis(problem, active)
    e, w = (np.asarray(part) for part in problem.compiled.linearised(x, directions))
    prior_gradient, hessian, effect_curvature = _prior_at(problem, active, x, directions)
    g_index, l_index = active.global_index, active.local_index
    n = len(g_index)
    weighted = np.asarray(active.weights)[:, None]
    score = (e[:, None, :] @ w)[:, 0]
    shared, transposed = w[..., :n], np.swapaxes(w, 1, 2)
    flat = (e.size, n)
    curvature = (shared * weighted[..., None]).reshape(flat).T @ shared.reshape(flat)
    cross, local = transposed[:, :n] @ w[..., n:], transposed[:, n:] @ w[..., n:]
    curvature = (
        curvature
        + hessian[:n][:, g_index]
        + np.diag(effect_curvature[g_index])
        - _bend_of_volume(problem, active)
    )
    cross = cross + np.moveaxis(hessian[:n][:, l_index], 0, 1)
    local = local + np.moveaxis(hessian[n:][:, l_index], 0, 1)
    for j in range(l_index.shape[1]):
        local[:, j, j] += effect_curvature[l_index[:, j]]
    return System(
        (weighted * score[:, :n]).sum(0) + prior_gradient[g_index],
        score[:, n:] + prior_gradient[l_index],
        curvature,
        cross,
        local,
        np.asarray(active.weights),
        effect_curvature,
    )


def _prior_at(
    problem: Problem, active: Active, x: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slope of all priors and of the volume; the base model's curvature along directions; that of effects' priors.

    What clusters share does not see the priors of unknowns of clusters that are left out; these follow their own cluster.
    """
    gradient, hessian = problem.compiled.prior(x, directions)
    if active.local_index.size and (active.weights != 1).any():
        shared = active.global_index
        weighted, curvature = problem.compiled.prior(x, directions, active.weights)
        gradient, hessian = gradient.copy(), hessian.copy()
        gradient[shared] = weighted[shared]
        hessian[: len(shared), shared] = curvature[: len(shared), shared]
    _, effect_gradient, effect_curvature = effect_prior(problem, active, x)
    gradient = gradient + effect_gradient
    if problem.volume is not None and len(active.global_index):
        gradient[problem.volume.index] += np.asarray(active.weights) @ problem.volume.gradient(x)
    return gradient, hessian, effect_curvature


def curved(problem: Problem, active: Active, x: np.ndarray, system: System) -> System:
    """A system whose curvatures are those of the log posterior itself at x.

    Those of Gauss and Newton leave out how predictions bend. Where residuals are large, as those of phases are beside a
    twin that is wrong elsewhere, steps by them hardly arrive.
    """
    g_index, l_index, n = active.global_index, active.local_index, len(active.global_index)
    weights = np.asarray(active.weights, float)
    rows = problem.compiled.curvature(x, weights, basis(problem, active))
    counts = (weights > 0)[:, None, None]
    each = np.where(counts, weights[:, None, None], 1.0)
    cross = np.moveaxis(rows[:n][:, l_index], 0, 1) / each
    local = (
        np.moveaxis(rows[n:][:, l_index], 0, -1) / each
        + np.eye(l_index.shape[1]) * system.bend[l_index][:, None]
    )
    curvature = rows[:n][:, g_index] + np.diag(system.bend[g_index]) - _bend_of_volume(problem, active)
    return replace(
        system,
        curvature=_finite(curvature, system.curvature),
        cross=np.where(counts, _finite(cross, system.cross), system.cross),
        local=np.where(counts, _finite(local, system.local), system.local),
    )


def _finite(told: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Curvatures (..., n, m), those that are not finite throughout replaced."""
    return np.where(np.isfinite(told).all(axis=(-2, -1), keepdims=True), told, otherwise)


def _bend_of_volume(problem: Problem, active: Active) -> np.ndarray:
    """The Hessian (global, global) of what integrating unknowns out adds; zeros without."""
    index = active.global_index
    result = np.zeros((len(index), len(index)))
    if problem.volume is not None and len(index):
        weights, volume = np.asarray(active.weights), problem.volume
        free = np.flatnonzero(np.isin(volume.index, index))
        place = np.searchsorted(index, volume.index[free])
        result[np.ix_(place, place)] = np.tensordot(weights, volume.bend, 1)[np.ix_(free, free)]
    return result


def rescored(problem: Problem, active: Active, x: np.ndarray, system: System) -> System:
    """A system whose scores are those at x, its curvatures as they were but for those of effects' priors.

    A gradient costs a few evaluations, however many coordinates are free; a system two for each of them.
    """
    g_index, l_index = active.global_index, active.local_index
    prior_gradient, _, bend = _prior_at(problem, active, x, np.zeros((0, problem.dimension)))
    slope = problem.compiled.slope(x, active.weights)
    own = slope
    if l_index.size and (active.weights != 1).any():
        own = problem.compiled.slope(x, np.ones_like(active.weights))
    change = bend - system.bend
    local = system.local + np.eye(l_index.shape[1]) * change[l_index][:, None]
    return replace(
        system,
        gradient=(slope + prior_gradient)[g_index],
        local_gradient=(own + prior_gradient)[l_index],
        curvature=system.curvature + np.diag(change[g_index]),
        local=local,
        bend=bend,
    )


def terms_of(problem: Problem, active: Active, x: np.ndarray) -> np.ndarray:
    """Log posterior as one global entry followed by one per cluster, without weights."""
    likelihood, prior, local = problem.compiled.evaluate(x)
    extra, _, _ = effect_prior(problem, active, x)
    return np.concatenate([[float(prior) + extra], likelihood + local])


def cluster_terms(problem: Problem, active: Active, x: np.ndarray) -> np.ndarray:
    """Log likelihood and local prior of each cluster."""
    terms = terms_of(problem, active, x)[1:]
    for name, sd in active.spread.items():
        for block in problem.blocks_of(name):
            if block.local:
                w = x[block.index]
                terms = terms - 0.5 * (w**2).sum(1) / sd**2 - block.size * (np.log(sd) + 0.5 * LOG_2PI)
    return terms


def value_of(problem: Problem, active: Active, x: np.ndarray) -> float:
    """What a fit maximises."""
    terms = terms_of(problem, active, x)
    value = terms[0] + float(active.weights @ np.where(active.weights > 0, terms[1:], 0.0))
    value += volume_of(problem, active, x)
    return value if np.isfinite(value) else -np.inf


def volume_of(problem: Problem, active: Active, x: np.ndarray) -> float:
    """What integrating unknowns out adds, where a problem asks for it."""
    return 0.0 if problem.volume is None else float(active.weights @ problem.volume.at(x))


def moved(problem: Problem, active: Active, x: np.ndarray, step: NewtonStep) -> np.ndarray:
    """The point x after a step, in which no cluster's own coordinate goes farther than it may."""
    x = x.copy()
    x[active.global_index] += step.shared
    if step.local.size:
        longest = farthest(problem)[active.local_index]
        x[active.local_index] += np.clip(step.local, -longest, longest)
    return x


def farthest(problem: Problem) -> Float[np.ndarray, " dimension"]:
    """How far each coordinate may move in a step: the base model's unknowns no farther than any prior expects.

    Where a likelihood is flat, as of a logarithm at minus infinity, or at the end of a uniform prior, nothing leads back.
    """
    deviation = problem.prior_spread.deviation  # of the base model's unknowns, which are the first ones
    longest = np.full(problem.dimension, np.inf)
    count = sum(block.index.size for block in problem.blocks_of(None))
    longest[:count] = np.where(deviation[:count] > 0, _FARTHEST * deviation[:count], np.inf)
    return longest
