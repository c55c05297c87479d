"""Fits whose cluster-local coordinates are at their best anywhere, or integrated out, cluster by cluster."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from dtprob.gap.fitting.active import LOG_2PI, Active, activate, basis, own_basis
from dtprob.gap.fitting.density import cluster_terms, curved, moved, rescored, system_at, terms_of
from dtprob.gap.fitting.fit import Fit, fit
from dtprob.gap.fitting.newton import System, local_step, positive
from dtprob.gap.fitting.states import are_states
from dtprob.gap.fitting.sweep import swept
from dtprob.gap.model.problem import Problem

_ROUNDS: Final = 4
_DAMPING: Final = 1e-3
"""Of a cluster's first step, as a share of its curvatures."""
_SLOW: Final = 2
"""Steps by which the curvatures of Gauss and Newton should have arrived."""
_HOLDS: Final = 0.25
"""Share of the last step's promise below which the next one's shows that kept curvatures still hold."""
_ROUNDED: Final = 8.0
"""Last digits of a log density that say nothing: near the mode steps gain less, and gradients lead."""
_GAIN: Final = 0.1
"""Nats by which a fit has to be better to be another one."""


def settled(problem: Problem, fitted: Fit) -> Fit:
    """The fit, or a better one, none of whose clusters is in a wrong basin of angles and what goes with them; see `swept`.

    Args:
        problem: the model and candidates on their data.
        fitted: to all clusters.
    """
    for _ in range(_ROUNDS):
        active = activate(problem, fitted.effects, spread=fitted.spread)
        terms = partial(cluster_terms, problem, active)
        x = swept(problem, fitted.x, terms)
        if x is fitted.x:  # nothing to look for together
            return fitted
        if not terms(x).sum() > terms(fitted.x).sum() + _GAIN:
            return fitted
        other = fit(problem, x, fitted.effects, spread=fitted.spread)
        if other.log_posterior < fitted.log_posterior + _GAIN:
            return fitted
        fitted = other
    return fitted


def marginal(problem: Problem, fitted: Fit, *, steps: int = 30) -> np.ndarray:
    """Log marginal likelihood of each cluster (cluster,) given the fit's global coordinates.

    Local coordinates are looked for over their whole range, refitted per cluster and integrated out by Laplace's method, so
    that clusters that the fit has not seen are judged fairly. States that clusters share are integrated out to first order,
    as far as the fit knows them.
    """
    active = activate(problem, fitted.effects, spread=fitted.spread)
    if not active.local_index.shape[1]:
        return terms_of(problem, active, fitted.x)[1:] + _widened(problem, active, fitted, fitted.x, None)
    x = swept(problem, fitted.x, partial(cluster_terms, problem, active))
    x, local = own_mode(problem, active, x, steps=steps)
    terms = cluster_terms(problem, active, x)
    volume = 0.5 * local.shape[-1] * LOG_2PI - 0.5 * np.linalg.slogdet(local)[1]
    return terms + volume + _widened(problem, active, fitted, x, local)


def _widened(
    problem: Problem,
    active: Active,
    fitted: Fit,
    x: Float[np.ndarray, " dimension"],
    local: Float[np.ndarray, "cluster own own"] | None,
) -> Float[np.ndarray, " cluster"]:
    """What it adds to clusters' log likelihoods that states are only known with their covariance at the fit, all else held.

    Without that, what a level that all states share leaves open would excuse what moves a whole cluster.

    With residuals e at the mode of the own coordinates, tangents A of these and W of the states, P the states' covariance,
    K = W P W' and M = 1 - A H^-1 A', by the lemmas of Woodbury and Sylvester: (e' (1 + K M)^-1 K e - log |1 + K M|) / 2.

    Args:
        problem: the model on its data.
        active: the free coordinates.
        fitted: the fit.
        x: the point.
        local: curvature H of own coordinates, their prior's included; None where there are none.
    """
    inner = are_states(problem, active)
    if not inner.any():
        return np.zeros(problem.n_cluster)
    along = np.concatenate([basis(problem, active)[: len(inner)][inner], own_basis(problem, active)])
    e, w = (np.asarray(part) for part in problem.compiled.linearised(x, along))
    states, own = np.split(w, [inner.sum()], axis=-1)
    known = states @ _given_others(fitted.covariance, inner) @ np.swapaxes(states, 1, 2)
    told = np.eye(e.shape[1])
    if local is not None:
        told = told - own @ np.linalg.solve(local, np.swapaxes(own, 1, 2))
    wide = np.eye(e.shape[1]) + known @ told
    inside = (e * np.linalg.solve(wide, known @ e[..., None])[..., 0]).sum(1)
    return 0.5 * (inside - np.linalg.slogdet(wide)[1])


def _given_others(
    covariance: Float[np.ndarray, "shared shared"], chosen: Bool[np.ndarray, " shared"]
) -> Float[np.ndarray, "chosen chosen"]:
    """Covariance of the chosen coordinates where the others are held."""
    cross = covariance[np.ix_(chosen, ~chosen)]
    others = covariance[np.ix_(~chosen, ~chosen)]
    return covariance[np.ix_(chosen, chosen)] - cross @ np.linalg.solve(others, cross.T)


def own_mode(
    problem: Problem,
    active: Active,
    x: np.ndarray,
    *,
    steps: int = 30,
    tolerance: float = 1e-3,
    near: System | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The point with each cluster's own coordinates at their mode given the shared ones, and their curvature there.

    Args:
        problem: the model and candidates on their data.
        active: which coordinates are free.
        x: where to start.
        steps: at most so many; those after the first two take the curvature of the log posterior itself, kept while it
            holds.
        tolerance: stop when the gain that a step promises, in nats per cluster, falls below.
        near: a system whose curvatures nearly hold, since the mode is near; see `following`.
    """
    x, terms, damping = x.copy(), cluster_terms(problem, active, x), np.full(problem.n_cluster, _DAMPING)
    own, promised, is_exact = active.own, np.inf, near is not None
    rounding = _ROUNDED * float(jnp.finfo(jnp.result_type(float)).eps)
    system = system_at(problem, own, x) if near is None else rescored(problem, own, x, near)
    for number in range(steps):
        step = local_step(system, damping)
        trial = moved(problem, own, x, step)
        new = cluster_terms(problem, active, trial)
        better = new > terms - rounding * np.abs(terms)
        x[active.local_index[better]] = trial[active.local_index[better]]
        terms = np.where(better, new, terms)
        damping = np.where(better, damping / 4, damping * 4)
        if step.gain < tolerance * problem.n_cluster:
            break
        if not is_exact and number + 1 < _SLOW:
            system = system_at(problem, own, x)
            continue
        system = rescored(problem, own, x, system)
        if not (is_exact and step.gain < _HOLDS * promised):
            system, is_exact = curved(problem, own, x, system), True
        promised = step.gain
    return x, positive(system_at(problem, own, x).local)


def following(
    problem: Problem, x: np.ndarray, effects: Sequence[str], index: Int[np.ndarray, " shared"]
) -> tuple[System, Float[np.ndarray, "cluster own shared"]]:
    """The system of the clusters' own coordinates at their mode, and how that mode moves with shared ones.

    Args:
        problem: the model on its data.
        x: the point.
        effects: names of the mean effects that are free.
        index: positions of the shared coordinates, of the model or of these effects.
    """
    active = activate(problem, effects)
    system = curved(problem, active, x, system_at(problem, active, x))
    place = np.searchsorted(active.global_index, index)
    cross = np.swapaxes(system.cross[:, place], 1, 2)
    return system.own, -np.nan_to_num(np.linalg.solve(positive(system.local), cross))
