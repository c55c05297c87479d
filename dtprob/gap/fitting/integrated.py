"""Integrating out what each cluster has of its own, where a mode over all unknowns at once would be wrong.

Such a mode is drawn to where the clusters' own unknowns have most room: a state for every reading lets the noise vanish,
the spread of levels grows as these shrink. Integrated out by Laplace's method, the own unknowns of cluster c add
V_c = -1/2 log |H_c| to the log density, H_c their curvature. About the mode of that density V_c is expanded to second
order, and every fit takes it along (Tierney and Kadane 1986; Rue, Martino and Chopin 2009, section 3).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Final, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.base import fit_base, followed
from dtprob.gap.fitting.density import terms_of
from dtprob.gap.fitting.fit import Fit, fit
from dtprob.gap.fitting.marginal import own_mode
from dtprob.gap.fitting.states import held, states, states_mode
from dtprob.gap.fitting.sweep import turned
from dtprob.gap.model.problem import Problem
from dtprob.gap.model.volume import Volume
from dtprob.gap.which.trials import Say, Start

_ROUNDS: Final = 10
_SHARES: Final = (1.0, 0.5, 0.25, 0.1, 0.03)
_ARRIVED: Final = 0.01
"""Nats by which a round has to be better."""
_FAR: Final = 1.0
"""Standard deviations of the prior that a coordinate moves in a round at most."""
_STEPS: Final = (0.1, 0.5)
"""Of the differences, in standard deviations of a coordinate's prior, and at most of its posterior."""
_DENSE: Final = 12
"""Shared coordinates up to which second differences between two of them are taken too."""
_MATTERS: Final = 4.0
"""Squared distance of a joint mode from the marginal one, in standard deviations, from which it is not taken."""
_RUNAWAY: Final = 10.0
"""Standard deviations of the prior beyond which a joint mode runs away."""
_EXACT: Final = 1e-7


def based(problem: Problem, key: jax.Array, *, polished: int = 3, say: Say = lambda _: None) -> Start:
    """The base fit: the joint mode, or where that is too far from the marginal one, the latter.

    Args:
        problem: the model on its data, without live effects.
        key: for prior draws.
        polished: how many of the fits are freed from local optima.
        say: told where unknowns are integrated out.

    Raises:
        InputError: the model has no finite likelihood from any start; what breaks is named.
    """
    shared, has_states = held(problem), bool(states(problem).blocks)
    if not (has_states or activate(problem).local_index.shape[1]) or not len(shared):
        return Start(problem, fit_base(problem, key, polished=polished))
    centre, deviation = problem.prior_middle
    scale = np.maximum(deviation[shared], 1e-12)
    centre = turned(problem, centre, problem.compiled.by_cluster)
    starts, step = [centre], _STEPS[0] * scale
    if not has_states and not _runs_away(problem, fit(problem, centre), centre, scale):
        joint = fit_base(problem, key, polished=polished)
        if not _runs_away(problem, joint, centre, scale):
            if _is_near_the_marginal_one(problem, joint, step):
                return Start(problem, joint)
            starts.append(joint.x)
    say(f"integrating out {'states' if has_states else 'what each cluster has of its own'}")
    here, height = max((_height(problem, x) for x in starts), key=lambda found: found[1])
    mode = _about_the_mode(problem, here, height, scale)
    whole = problem.with_volume(mode.volume)
    found = followed(whole, fit(whole, mode.x))
    if _height(problem, found.x)[1] < mode.height - _ARRIVED:
        found = replace(fit(whole, mode.x, steps=0), converged=mode.arrived)
    return Start(whole, found)


class _Mode(NamedTuple):
    """Of the marginal density: where, its logarithm, the expansion there, and whether the last round gained nothing."""

    x: np.ndarray
    height: float
    volume: Volume
    arrived: bool


def _is_near_the_marginal_one(problem: Problem, joint: Fit, step: np.ndarray) -> bool:
    """Whether a joint mode is no farther from the marginal one than what the data tell apart."""
    near = np.minimum(step, _STEPS[1] * np.sqrt(np.diag(joint.covariance)))
    up, down = _beside(problem, joint.x, near)
    slope = (up - down).sum(axis=0) / (2 * near)
    return bool(slope @ joint.covariance @ slope < _MATTERS)


def _runs_away(problem: Problem, first: Fit, centre: np.ndarray, scale: np.ndarray) -> bool:
    """Whether a joint mode that was sought from a sound point lies where no prior expects it, or nowhere."""
    if not np.isfinite(terms_of(problem, activate(problem), centre)).all():
        return False
    away = np.abs(first.x - centre)[first.global_index] / scale
    lost = not np.isfinite(first.log_posterior)
    return not first.converged and (lost or bool(away.max() > _RUNAWAY))


def _about_the_mode(problem: Problem, here: np.ndarray, height: float, scale: np.ndarray) -> _Mode:
    """The mode of the marginal density, from a point and the log density there."""
    shared = held(problem)
    for _ in range(_ROUNDS):
        volume = _expanded(problem, here, _STEPS[0] * scale)
        move = (fit(problem.with_volume(volume), here).x - here)[shared]
        move *= min(1.0, _FAR / float(np.max(np.abs(move) / scale, initial=1e-300)))
        best, highest = here, height
        for share in _SHARES:
            trial = here.copy()
            trial[shared] += share * move
            trial, value = _height(problem, trial)
            if value > height:
                best, highest = trial, value
                break
        if highest - height < _ARRIVED:
            return _Mode(here, height, volume, arrived=True)
        here, height = best, highest
    return _Mode(here, height, _expanded(problem, here, _STEPS[0] * scale), arrived=False)


def _height(problem: Problem, x: np.ndarray) -> tuple[np.ndarray, float]:
    """The point with what is integrated out at its mode, and the log density without it."""
    x, volume = _inner(problem, x)
    total = float(terms_of(problem, activate(problem), x).sum()) + float(volume.sum())
    return x, total if np.isfinite(total) else -np.inf


def _inner(
    problem: Problem, x: np.ndarray, tolerance: float = 1e-3
) -> tuple[np.ndarray, Float[np.ndarray, " cluster"]]:
    """The point with what is integrated out, states or the clusters' own unknowns, at its mode, and V_c there."""
    shared_states = states(problem)
    if shared_states.blocks:
        x, curvature = states_mode(problem, shared_states, x, tolerance=tolerance)
        volume = -0.5 * np.linalg.slogdet(curvature)[1]
        return x, np.full(problem.n_cluster, volume / problem.n_cluster)
    x, local = own_mode(problem, activate(problem), x, tolerance=tolerance)
    return x, -0.5 * np.linalg.slogdet(local)[1]


def _volume_at(problem: Problem, x: np.ndarray, move: np.ndarray) -> np.ndarray:
    """V_c (cluster,) where the shared coordinates are moved from a point, what is integrated out following."""
    moved = x.copy()
    moved[held(problem)] += move
    return _inner(problem, moved, _EXACT)[1]


def _beside(problem: Problem, x: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """V_c (cluster, shared) a step up and a step down each shared coordinate."""
    up, down = (
        np.stack([_volume_at(problem, x, sign * unit) for unit in np.diag(step)], axis=1)
        for sign in (1.0, -1.0)
    )
    return up, down


def _expanded(problem: Problem, x: np.ndarray, step: np.ndarray) -> Volume:
    """V_c about a point, by central differences; what curves upwards is taken as straight."""
    n, units = len(step), np.diag(step)
    middle = _volume_at(problem, x, np.zeros(n))
    up, down = _beside(problem, x, step)
    slope = (up - down) / 2
    bend = (up + down - 2 * middle[:, None])[:, :, None] * np.eye(n)
    for i, j in combinations(range(n if n <= _DENSE else 0), 2):
        both = sum(_volume_at(problem, x, sign * (units[i] + units[j])) for sign in (1.0, -1.0))
        bend[:, i, j] = bend[:, j, i] = both / 2 - middle - (bend[:, i, i] + bend[:, j, j]) / 2
    value, slope, bend = (np.nan_to_num(part, posinf=0.0, neginf=0.0) for part in (middle, slope, bend))
    values, vectors = np.linalg.eigh(bend)
    bend = np.einsum("cij,cj,ckj->cik", vectors, np.minimum(values, 0.0), vectors)
    shared = held(problem)
    return Volume(shared, x[shared], value, slope / step, bend / np.outer(step, step))
