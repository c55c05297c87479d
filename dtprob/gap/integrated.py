"""Integrating out what each cluster has of its own, where a mode over all unknowns at once would be wrong.

Such a mode is drawn to where the clusters' own unknowns have most room: a state for every reading lets the noise vanish,
the spread of levels grows as these shrink. Integrated out by Laplace's method, the own unknowns of cluster c add
V_c = -1/2 log |H_c| to the log density, H_c their curvature. About the mode of that density V_c is expanded to second
order, and every fit takes it along (Tierney and Kadane 1986; Rue, Martino and Chopin 2009, section 3).
"""

from __future__ import annotations

from itertools import combinations
from typing import Final

import jax
import numpy as np

from dtprob.gap.active import activate
from dtprob.gap.base import fit_base
from dtprob.gap.fit import fit, own_mode, terms_of
from dtprob.gap.problem import Problem
from dtprob.gap.sweep import turned
from dtprob.gap.trials import Say, Start
from dtprob.gap.volume import Volume

_ROUNDS: Final = 10
_SHARES: Final = (1.0, 0.5, 0.25, 0.1, 0.03)
_ARRIVED: Final = 0.01
"""Nats by which a round has to be better."""
_FAR: Final = 1.0
"""Standard deviations of the prior that a coordinate moves in a round at most."""
_STEP: Final = 0.1
"""Of the differences, in standard deviations of a coordinate's prior."""
_DENSE: Final = 12
"""Shared coordinates up to which second differences between two of them are taken too."""
_MATTERS: Final = 4.0
"""Squared distance of a joint mode from the marginal one, in standard deviations, from which it is not taken."""
_RUNAWAY: Final = 10.0
"""Standard deviations of the prior beyond which a joint mode runs away."""
_EXACT: Final = 1e-7
_DRAWS: Final = 256


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
    shared = problem.shared_index
    if not activate(problem).local_index.shape[1] or not len(shared):
        return Start(problem, fit_base(problem, key, polished=polished))
    draws = problem.prior_draws(jax.random.key(0), _DRAWS)
    centre, scale = np.median(draws, axis=0), draws.std(axis=0)[shared]
    first = fit(problem, turned(problem, centre, problem.compiled.by_cluster))
    away = np.abs(first.x - centre)[shared] / scale
    if first.converged or (np.isfinite(first.log_posterior) and away.max() < _RUNAWAY):
        joint = fit_base(problem, key, polished=polished)
        slope = _expanded(problem, joint.x, scale).slope.sum(axis=0)
        if slope @ joint.covariance @ slope < _MATTERS:
            return Start(problem, joint)
    say("integrating out what each cluster has of its own")
    volume = _about_the_mode(problem, centre, scale)
    whole = problem.with_volume(volume)
    return Start(whole, fit(whole, volume.origin))


def _about_the_mode(problem: Problem, start: np.ndarray, scale: np.ndarray) -> Volume:
    """The expansion about the mode of the marginal density."""
    shared = problem.shared_index
    here, height = _height(problem, start)
    for _ in range(_ROUNDS):
        volume = _expanded(problem, here, scale)
        there = fit(problem.with_volume(volume), here).x
        move = there[shared] - here[shared]
        move *= min(1.0, _FAR / float(np.max(np.abs(move) / scale, initial=1e-300)))
        best, highest = here, height
        for share in _SHARES:
            trial = here.copy()
            trial[shared] += share * move
            trial, value = _height(problem, trial)
            if value > height:
                best, highest = trial, value
                break
        gain, here, height = highest - height, best, highest
        if gain < _ARRIVED:
            return volume
    return _expanded(problem, here, scale)


def _height(problem: Problem, x: np.ndarray) -> tuple[np.ndarray, float]:
    """The point with each cluster's own unknowns at their mode, and the log density with these integrated out."""
    active = activate(problem)
    x, local = own_mode(problem, active, x)
    total = float(terms_of(problem, active, x).sum()) - 0.5 * float(np.linalg.slogdet(local)[1].sum())
    return x, total if np.isfinite(total) else -np.inf


def _expanded(problem: Problem, x: np.ndarray, scale: np.ndarray) -> Volume:
    """V_c about a point, by central differences."""
    shared, n = problem.shared_index, len(problem.shared_index)
    active = activate(problem)

    def at(*moves: tuple[int, float]) -> np.ndarray:
        moved = x.copy()
        for i, sign in moves:
            moved[shared[i]] += sign * _STEP * scale[i]
        return -0.5 * np.linalg.slogdet(own_mode(problem, active, moved, tolerance=_EXACT)[1])[1]

    middle = at()
    up, down = ([at((i, sign)) for i in range(n)] for sign in (1.0, -1.0))
    slope = np.stack([(u - d) / 2 for u, d in zip(up, down, strict=True)], axis=1)
    bend = np.zeros((len(middle), n, n))
    for i in range(n):
        bend[:, i, i] = up[i] + down[i] - 2 * middle
    for i, j in combinations(range(n if n <= _DENSE else 0), 2):
        bend[:, i, j] = bend[:, j, i] = at((i, 1.0), (j, 1.0)) - up[i] - up[j] + middle
    step = _STEP * scale
    return Volume(x, x[shared], middle, slope / step, _downwards(bend) / np.outer(step, step))


def _downwards(bend: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(np.nan_to_num(bend, posinf=0.0, neginf=0.0))
    return np.einsum("cij,cj,ckj->cik", vectors, np.minimum(values, 0.0), vectors)
