"""Gauss-Newton refits of any subset of coordinates, with cluster-local ones eliminated cluster by cluster.

A fit finds the posterior mode of the global nuisances, the local ones, the parameters of chosen effects and the fields of
chosen variance effects (whose standard deviations are re-estimated at every step). The curvature is the Fisher information
plus the prior's, so the log evidence (Laplace) and the marginal log likelihood of each cluster come with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.active import LOG_2PI, Active, activate, basis, effect_prior
from dtprob.gap.fitting.newton import NewtonStep, System, local_step, newton_step, positive
from dtprob.gap.fitting.plausible import mixing_gain, nulls, places, scales, sides
from dtprob.gap.fitting.sweep import swept
from dtprob.gap.model.problem import Problem

_TRIES: Final = 8
_SETTLED: Final = 0.01
"""Change of the logarithm of a field's standard deviation below which it stands."""
_FEWEST, _FAINTEST = 0.5, 1e-9
_LONGEST: Final = float(np.log(3.0))
_LEAST_DAMPING: Final = 1e-12
_ROUNDS: Final = 4
_GAIN: Final = 0.1
"""Nats by which a fit has to be better to be another one."""
_STUCK: Final = 1e3
"""Damping beyond which a fit has arrived, whatever its quadratic promises."""


type Changes = Mapping[str, float]
"""The last change of the logarithm of each field's standard deviation; empty after one that was extrapolated."""


@dataclass(frozen=True)
class Fit:
    """A posterior mode.

    Attributes:
        x: the flat vector.
        effects: names of the effects that were free.
        spread: standard deviation of each free variance effect's field.
        log_posterior: log likelihood plus log prior at the mode, and the volume where there is one, over the clusters that
            the fit used.
        log_evidence: its Laplace approximation of the log marginal likelihood.
        covariance: of the free global coordinates, in the order of `global_index`.
        global_index: their positions in the flat vector.
        converged: whether the last step was negligible.
    """

    x: np.ndarray
    effects: tuple[str, ...]
    spread: dict[str, float]
    log_posterior: float
    log_evidence: float
    covariance: np.ndarray
    global_index: np.ndarray
    converged: bool


def _system(problem: Problem, active: Active, x: np.ndarray) -> System:
    directions = basis(problem, active)
    e, w = (np.asarray(part) for part in problem.compiled.linearised(x, directions))
    prior_gradient, hessian = problem.compiled.prior(x, directions)
    g_index, l_index = active.global_index, active.local_index
    n = len(g_index)
    weighted = np.asarray(active.weights)[:, None]
    score = (e[:, None, :] @ w)[:, 0]
    shared, transposed = w[..., :n], np.swapaxes(w, 1, 2)
    flat = (e.size, n)
    curvature = (shared * weighted[..., None]).reshape(flat).T @ shared.reshape(flat)
    cross, local = transposed[:, :n] @ w[..., n:], transposed[:, n:] @ w[..., n:]
    _, effect_gradient, effect_curvature = effect_prior(problem, active, x)
    prior_gradient = prior_gradient + effect_gradient
    curvature = curvature + hessian[:n][:, g_index] + np.diag(effect_curvature[g_index])
    if problem.volume is not None:
        base, weights = active.base_index, np.asarray(active.weights)
        place = np.isin(g_index, base)
        prior_gradient[base] += weights @ problem.volume.gradient(x[base])
        curvature[np.ix_(place, place)] -= np.tensordot(weights, problem.volume.bend, 1)
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
    )


def terms_of(problem: Problem, active: Active, x: np.ndarray) -> np.ndarray:
    """Log posterior as one global entry followed by one per cluster, without weights."""
    likelihood, prior, local = problem.compiled.evaluate(x)
    extra, _, _ = effect_prior(problem, active, x)
    return np.concatenate([[float(prior) + extra], likelihood + local])


def _value(problem: Problem, active: Active, x: np.ndarray) -> float:
    """What a fit maximises."""
    terms = terms_of(problem, active, x)
    value = terms[0] + float(active.weights @ np.where(active.weights > 0, terms[1:], 0.0))
    value += _volume(problem, active, x)
    return value if np.isfinite(value) else -np.inf


def _volume(problem: Problem, active: Active, x: np.ndarray) -> float:
    """What integrating the clusters' own unknowns out adds, where a problem asks for it."""
    return 0.0 if problem.volume is None else float(active.weights @ problem.volume.at(x[active.base_index]))


@np.errstate(over="ignore", invalid="ignore")  # bad starting points lead far out
def fit(
    problem: Problem,
    x: np.ndarray,
    effects: Sequence[str] = (),
    *,
    weights: np.ndarray | None = None,
    steps: int = 40,
    tolerance: float = 1e-3,
    spread: Mapping[str, float] = MappingProxyType({}),
) -> Fit:
    """Posterior mode from the starting point x.

    Args:
        problem: the model and candidates on their data.
        x: flat vector to start from; coordinates of effects that are not free stay as they are.
        effects: names of the effects that are free.
        weights: per cluster, 0 leaves it out of the fit.
        steps: at most so many Gauss-Newton steps.
        tolerance: stop when the predicted gain in nats falls below.
        spread: first standard deviation of variance effects' fields by name; see `activate`.
    """
    active = activate(problem, effects, weights, spread)
    x, damping, converged = np.array(x, float), 1e-3, False
    value = _value(problem, active, x)
    if value == -np.inf and not np.isfinite(problem.compiled.residual(x)).all():
        return _hopeless(active, x)
    latest: Changes = {}
    for _ in range(steps):
        system = _system(problem, active, x)
        if not system.finite:
            return _hopeless(active, x)
        trial = _better(problem, active, system, x, value=value, damping=damping, tolerance=tolerance)
        better = trial.value > value
        converged = trial.gain < tolerance or (not better and trial.damping > _STUCK)
        if better:
            x, value, damping = trial.x, trial.value, max(trial.damping / 8, _LEAST_DAMPING)
        change = 0.0
        if active.spread:
            active, change, latest = _respread(problem, active, x, system, latest)
            value = _value(problem, active, x)
        converged = converged and change < _SETTLED
        if converged or not (better or change >= _SETTLED):
            break
    return _finish(problem, active, x, value, converged)


def _hopeless(active: Active, x: np.ndarray) -> Fit:
    """The fit of a starting point that leads where the model or its derivatives are not finite."""
    index, names = active.global_index, tuple(e.name for e in active.effects)
    return Fit(x, names, active.spread, -np.inf, -np.inf, np.eye(len(index)), index, False)


class _Trial(NamedTuple):
    """Where a step leads, the log posterior there, the gain that was promised, and the damping that it took."""

    x: np.ndarray
    value: float
    gain: float
    damping: float


def _better(
    problem: Problem,
    active: Active,
    system: System,
    x: np.ndarray,
    *,
    value: float,
    damping: float,
    tolerance: float,
) -> _Trial:
    """The first of ever more damped steps that raises the log posterior, or the last that did not."""
    lowest = _lowest(problem, active, x)
    trial = _Trial(x, value, 0.0, damping)
    for _ in range(_TRIES):
        step = newton_step(system, damping, lowest)
        moved = _moved(active, x, step)
        trial = _Trial(moved, _value(problem, active, moved), step.gain, damping)
        if trial.value > value:
            break
        damping = max(4 * damping, 1e-6)
        trial = trial._replace(damping=damping)
        if step.gain < tolerance:
            break
    return trial


def _moved(active: Active, x: np.ndarray, step: NewtonStep) -> np.ndarray:
    x = x.copy()
    x[active.global_index] += step.shared
    if step.local.size:
        x[active.local_index] += step.local
    return x


def _lowest(problem: Problem, active: Active, x: np.ndarray) -> np.ndarray:
    """The smallest step of each global coordinate: one-sided parameters stay on their side of the null."""
    lowest = np.full(len(x), -np.inf)
    for effect in active.effects:
        if effect.kind == "mean":
            index = problem.layout.indices(effect.site_name(p.name) for p in effect.parameters)
            lowest[index] = np.where(sides(effect), nulls(effect) - x[index], -np.inf)
    return lowest[active.global_index]


def _respread(
    problem: Problem, active: Active, x: np.ndarray, system: System, latest: Changes
) -> tuple[Active, float, Changes]:
    """New standard deviations of variance effects, the largest change of their logarithms, and the next `latest`.

    sd^2 <- sum x^2 / gamma, gamma = sum (1 - var / sd^2) the number of entries that the data determine (MacKay, Neural
    Computation 4 (1992) 415): the same fixed point as EM, reached in fewer steps. Where a field is weak these steps
    shrink slowly, so every second one is extrapolated to the limit of a geometric series (Aitken). No step is longer
    than a factor of 3.
    """
    spread, changes = dict(active.spread), dict[str, float]()
    own = np.zeros(problem.dimension)
    own[active.global_index] = np.diag(np.linalg.inv(positive(system.curvature)))
    if active.local_index.size:
        own[active.local_index] = np.einsum("cii->ci", np.linalg.inv(positive(system.local)))
    for name, sd in active.spread.items():
        blocks = problem.blocks_of(name)
        kept = [b.index[active.weights > 0] if b.local else b.index for b in blocks]
        index = np.concatenate([i.reshape(-1) for i in kept])
        determined = max(float(np.sum(1 - own[index] / sd**2)), _FEWEST)
        step = float(np.log(np.sqrt(np.sum(x[index] ** 2) / determined) / sd + 1e-300))
        shrink = step / latest[name] if latest.get(name) else 0.0
        step = step / (1 - shrink) if 0 < shrink < 1 else step
        spread[name] = max(sd * float(np.exp(np.clip(step, -_LONGEST, _LONGEST))), _FAINTEST)
        changes[name] = float(np.log(spread[name] / sd))
    change = max(abs(c) for c in changes.values())
    return replace(active, spread=spread), change, {} if latest else changes


def _finish(problem: Problem, active: Active, x: np.ndarray, value: float, converged: bool) -> Fit:
    system = _system(problem, active, x)
    if not system.finite:
        return _hopeless(active, x)
    local = positive(system.local)
    schur = system.curvature
    n_local = local.shape[-1]
    evidence = value - _volume(problem, active, x)  # told anew, not expanded
    evidence += 0.5 * (len(active.global_index) + n_local * active.weights.sum()) * LOG_2PI
    if n_local:
        eliminated = np.linalg.solve(local, np.swapaxes(system.cross, 1, 2))
        schur = schur - np.einsum("c,cij,cjk->ik", active.weights, system.cross, eliminated)
        evidence -= 0.5 * float(active.weights @ np.linalg.slogdet(local)[1])
    if not np.isfinite(schur).all():
        return _hopeless(active, x)
    schur = positive(schur)
    evidence -= 0.5 * float(np.linalg.slogdet(schur)[1]) if len(schur) else 0.0
    covariance = np.linalg.inv(schur) if len(schur) else schur
    evidence += sum(_mixed(problem, active, x, covariance, e) for e in active.effects if e.kind == "mean")
    names = tuple(e.name for e in active.effects)
    return Fit(x, names, active.spread, value, evidence, covariance, active.global_index, converged)


def _mixed(problem: Problem, active: Active, x: np.ndarray, covariance: np.ndarray, effect: Effect) -> float:
    """What mixing the scale of an effect's prior adds to the log evidence."""
    index = problem.layout.indices(effect.site_name(p.name) for p in effect.parameters)
    place = np.ix_(*[[int(np.flatnonzero(active.global_index == i)[0]) for i in index]] * 2)
    sided = bool(sides(effect).all()) and len(index) == 1
    moved = x[index] - nulls(effect)
    return mixing_gain(covariance[place], moved, scales(effect), one_sided=sided, places=places(effect))


def settled(problem: Problem, fitted: Fit) -> Fit:
    """The fit, or a better one, none of whose clusters is in a wrong basin of angles and what goes with them; see `swept`.

    Args:
        problem: the model and candidates on their data.
        fitted: to all clusters.
    """
    for _ in range(_ROUNDS):
        active = activate(problem, fitted.effects, spread=fitted.spread)
        terms = partial(_cluster_terms, problem, active)
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


def marginal(problem: Problem, fitted: Fit, *, steps: int = 20) -> np.ndarray:
    """Log marginal likelihood of each cluster (cluster,) given the fit's global coordinates.

    Local coordinates are looked for over their whole range, refitted per cluster and integrated out by Laplace's method, so
    that clusters that the fit has not seen are judged fairly.
    """
    active = activate(problem, fitted.effects, spread=fitted.spread)
    if not active.local_index.shape[1]:
        return terms_of(problem, active, fitted.x)[1:]
    x = swept(problem, fitted.x, partial(_cluster_terms, problem, active))
    x, local = own_mode(problem, active, x, steps=steps)
    terms = _cluster_terms(problem, active, x)
    return terms + 0.5 * local.shape[-1] * LOG_2PI - 0.5 * np.linalg.slogdet(local)[1]


def own_mode(
    problem: Problem, active: Active, x: np.ndarray, *, steps: int = 20, tolerance: float = 1e-3
) -> tuple[np.ndarray, np.ndarray]:
    """The point with each cluster's own coordinates at their mode given the shared ones, and their curvature there.

    Args:
        problem: the model and candidates on their data.
        active: which coordinates are free.
        x: where to start.
        steps: at most so many Gauss-Newton steps.
        tolerance: stop when the gain that a step promises, in nats per cluster, falls below.
    """
    x, terms, damping = x.copy(), _cluster_terms(problem, active, x), np.float64(1e-3)
    for _ in range(steps):
        step = local_step(_system(problem, active, x), float(damping))
        trial = _moved(active, x, step)
        new = _cluster_terms(problem, active, trial)
        better = new > terms
        x[active.local_index[better]] = trial[active.local_index[better]]
        terms = np.where(better, new, terms)
        damping = damping / 4 if better.all() else damping * 4
        if step.gain < tolerance * problem.n_cluster:
            break
    return x, positive(_system(problem, active, x).local)


def _cluster_terms(problem: Problem, active: Active, x: np.ndarray) -> np.ndarray:
    """Log likelihood and local prior of each cluster."""
    terms = terms_of(problem, active, x)[1:]
    for name, sd in active.spread.items():
        for block in problem.blocks_of(name):
            if block.local:
                w = x[block.index]
                terms = terms - 0.5 * (w**2).sum(1) / sd**2 - block.size * (np.log(sd) + 0.5 * LOG_2PI)
    return terms
