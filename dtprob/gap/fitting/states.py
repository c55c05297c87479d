"""States and levels that clusters share, found together and integrated out.

The mode of levels and of their spread at once makes the spread too large, as levels in units of it shrink; with states
for about every reading of a series the noise vanishes. Integrated out by Laplace's method they add V = -1/2 log |H| to the
log density, H their curvature, of which each cluster is given the same part.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

from dtprob.gap.fitting.active import Active, activate
from dtprob.gap.fitting.density import moved, system_at, value_of
from dtprob.gap.fitting.newton import newton_step
from dtprob.gap.model.problem import Problem

_MANY: Final = 0.25
"""Unknowns for each observed value from which the largest of them are states."""
_LARGE: Final = 32
"""Entries of an unknown, shared or of each cluster, from which they may be states."""
_NORMAL: Final = ("Normal", "MultivariateNormal", "GaussianRandomWalk")
"""Distributions of states."""


def states(problem: Problem) -> Active:
    """The states of the base model, and beside them what clusters have of their own, as the only free coordinates.

    States are what is drawn in units of an unknown spread, and all that is large where nearly every reading has one.
    """
    active, sites = activate(problem), problem.declaration.sites
    shared = [b for b in active.blocks if not b.local]
    many = sum(b.size for b in shared) >= _MANY * problem.observed.count
    chosen = (
        b.name in problem.in_units or (many and b.size >= _LARGE and sites[b.name].distribution in _NORMAL)
        for b in shared
    )
    found = tuple(b for b, is_state in zip(shared, chosen, strict=True) if is_state)
    return replace(active, blocks=(*found, *(b for b in active.blocks if b.local)) if found else ())


def each_has_states(problem: Problem) -> bool:
    """Whether about every reading of a cluster has an unknown of the cluster's own."""
    own = activate(problem).local_index
    return own.shape[1] >= _LARGE and own.size >= _MANY * problem.observed.count


def are_states(problem: Problem, active: Active) -> Bool[np.ndarray, " shared"]:
    """Which of the global coordinates of a fit are states."""
    return np.isin(active.global_index, states(problem).global_index)


def held(problem: Problem) -> Int[np.ndarray, " shared"]:
    """Positions of what the base model's clusters share besides states."""
    return np.setdiff1d(activate(problem).global_index, states(problem).global_index)


def states_following(
    problem: Problem, x: np.ndarray, index: Int[np.ndarray, " shared"]
) -> Float[np.ndarray, "dimension shared"]:
    """How the mode of states, and of what clusters have of their own beside them, moves with other shared coordinates.

    Args:
        problem: the model on its data.
        x: the point, states at their mode.
        index: positions of the other shared coordinates, of the model or of effects.
    """
    active = states(problem)
    along = np.zeros((len(index), problem.dimension))
    along[np.arange(len(index)), index] = 1.0
    pulled = problem.compiled.curvature(x, np.ones(problem.n_cluster), along)
    system = system_at(problem, active, x)
    local, schur = system.eliminated()
    shared, own = -pulled[:, active.global_index].T, -np.moveaxis(pulled[:, active.local_index], 0, -1)
    if own.shape[1]:
        shared = shared - np.einsum("csl,clk->sk", system.cross, np.linalg.solve(local, own))
    shared = np.linalg.solve(schur, shared)
    along[:, active.global_index] = shared.T
    if own.shape[1]:
        own = np.linalg.solve(local, own - np.swapaxes(system.cross, 1, 2) @ shared)
        along[:, active.local_index] = np.moveaxis(own, -1, 0)
    return np.nan_to_num(along, posinf=0.0, neginf=0.0).T


def states_mode(
    problem: Problem, active: Active, x: np.ndarray, *, steps: int = 20, tolerance: float = 1e-3
) -> tuple[Float[np.ndarray, " dimension"], Float[np.ndarray, " cluster"]]:
    """The point with states at their mode given all else, and V_c there; that of states in equal parts.

    Args:
        problem: the model on its data, nothing of it integrated out.
        active: the states, and beside them what clusters have of their own.
        x: where to start.
        steps: at most so many Gauss-Newton steps.
        tolerance: stop when the gain that a step promises, in nats, falls below.
    """
    lowest = np.full(len(active.global_index), -np.inf)
    damping, value = 0.0, value_of(problem, active, x)
    system = system_at(problem, active, x)
    for _ in range(steps):
        step = newton_step(system, damping, lowest)
        trial = moved(problem, active, x, step)
        new = value_of(problem, active, trial)
        if new > value:
            x, value, damping = trial, new, damping / 8
            system = system_at(problem, active, x)
        else:
            damping = max(4 * damping, 1e-3)
        if step.gain < tolerance:
            break
    local, schur = system.eliminated()
    volume = np.full(problem.n_cluster, -0.5 * np.linalg.slogdet(schur)[1] / problem.n_cluster)
    return x, volume - 0.5 * np.linalg.slogdet(local)[1] if local.shape[-1] else volume
