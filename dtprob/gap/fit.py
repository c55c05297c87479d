"""Gauss-Newton refits of any subset of coordinates, with cluster-local ones eliminated cluster by cluster.

A fit finds the posterior mode of the global nuisances, the local ones, the parameters of chosen effects and the fields of
chosen variance effects (whose standard deviations are re-estimated at every step). The curvature is the Fisher information
plus the prior's, so the log evidence (Laplace) and the marginal log likelihood of each cluster come with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from scipy import linalg

from dtprob.effects.effect import Effect
from dtprob.gap.plausible import mixing_gain
from dtprob.gap.problem import Block, Problem

_LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Fit:
    """A posterior mode.

    Attributes:
        x: the flat vector.
        effects: names of the effects that were free.
        spread: standard deviation of each free variance effect's field.
        log_posterior: log likelihood plus log prior at the mode, over the clusters that the fit used.
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


@dataclass(frozen=True)
class _System:
    """Normal equations: gradient and curvature of the log posterior in global and local coordinates."""

    gradient: np.ndarray
    local_gradient: np.ndarray
    curvature: np.ndarray
    cross: np.ndarray
    local: np.ndarray


@dataclass(frozen=True)
class Active:
    """Which coordinates a fit moves, and the priors that are not the base model's."""

    blocks: tuple[Block, ...]
    effects: tuple[Effect, ...]
    weights: np.ndarray
    spread: dict[str, float]

    @property
    def global_index(self) -> np.ndarray:
        """Positions of the global coordinates."""
        parts = [b.index[0] for b in self.blocks if not b.local]
        return np.concatenate(parts) if parts else np.zeros(0, int)

    @property
    def local_index(self) -> np.ndarray:
        """Positions of the local coordinates, (cluster, local)."""
        parts = [b.index for b in self.blocks if b.local]
        return np.concatenate(parts, axis=1) if parts else np.zeros((len(self.weights), 0), int)


def activate(
    problem: Problem, effects: Sequence[str] = (), weights: np.ndarray | None = None, spread: float = 0.1
) -> Active:
    """The base model's nuisances and the named effects, with a weight per cluster (one by default)."""
    chosen = tuple(e for e in problem.live if e.name in effects)
    blocks = [b for b in problem.layout.blocks if b.owner is None or b.owner in effects]
    weights = np.ones(problem.n_cluster) if weights is None else weights
    return Active(tuple(blocks), chosen, weights, {e.name: spread for e in chosen if e.kind == "variance"})


def effect_prior(problem: Problem, active: Active, x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Log prior, its gradient and minus its curvature (diagonal) for the free effects' coordinates."""
    total = 0.0
    gradient, curvature = np.zeros(problem.dimension), np.zeros(problem.dimension)
    for effect in active.effects:
        if effect.kind == "variance":
            sd = active.spread[effect.name]
            for block in problem.blocks_of(effect.name):
                w = x[block.index]
                total += float(-0.5 * np.sum(w**2) / sd**2 - w.size * (np.log(sd) + 0.5 * _LOG_2PI))
                gradient[block.index] = -w / sd**2
                curvature[block.index] = 1 / sd**2
            continue
        for parameter in effect.parameters:
            block = problem.layout[effect.site_name(parameter.name)]
            value = jnp.asarray(x[block.index[0]]).reshape(parameter.shape)
            sd = np.asarray(prior_scale(parameter.prior)) * np.ones(parameter.shape)
            inside = jnp.maximum(value, parameter.null + 1e-9 * sd) if parameter.is_one_sided else value
            total += float(jnp.sum(parameter.prior.log_prob(inside)))  # the null may not count as support
            gradient[block.index[0]] = -((np.asarray(value) - parameter.null) / sd**2).reshape(-1)
            curvature[block.index[0]] = (1 / sd**2 * np.ones(parameter.shape)).reshape(-1)
    return total, gradient, curvature


def prior_scale(prior: object) -> np.ndarray:
    """Standard deviation of an effect's prior, from its variance or its second moment."""
    base = prior
    while hasattr(base, "base_dist"):
        base = base.base_dist  # pyright: ignore
    scale = getattr(base, "scale", None)
    return np.asarray(scale if scale is not None else np.sqrt(np.asarray(prior.variance)))  # pyright: ignore


def basis(problem: Problem, active: Active) -> np.ndarray:
    """One direction per global coordinate, then one per local coordinate that moves it in all clusters at once."""
    n_global, n_local = len(active.global_index), active.local_index.shape[1]
    directions = np.zeros((n_global + n_local, problem.dimension))
    directions[np.arange(n_global), active.global_index] = 1.0
    for j in range(n_local):
        directions[n_global + j, active.local_index[:, j]] = 1.0
    return directions


def _system(problem: Problem, active: Active, x: np.ndarray) -> _System:
    directions = basis(problem, active)
    w = problem.compiled.columns(x, directions)
    e = problem.compiled.residual(x)
    g_index, l_index = active.global_index, active.local_index
    n = len(g_index)
    weight = jnp.asarray(active.weights)
    score = np.asarray(jnp.einsum("cmk,cm->ck", w, e))
    weighted = np.asarray(active.weights)[:, None]
    curvature = np.asarray(jnp.einsum("c,cmi,cmj->ij", weight, w[..., :n], w[..., :n]))
    cross = np.asarray(jnp.einsum("cmi,cmj->cij", w[..., :n], w[..., n:]))
    local = np.asarray(jnp.einsum("cmi,cmj->cij", w[..., n:], w[..., n:]))
    prior_gradient = np.asarray(problem.compiled.prior_gradient(x))
    hessian = np.asarray(problem.compiled.prior_curvature(x, directions))
    _, effect_gradient, effect_curvature = effect_prior(problem, active, x)
    prior_gradient = prior_gradient + effect_gradient
    curvature = curvature + hessian[:n][:, g_index] + np.diag(effect_curvature[g_index])
    cross = cross + np.moveaxis(hessian[:n][:, l_index], 0, 1)
    local = local + np.moveaxis(hessian[n:][:, l_index], 0, 1)
    for j in range(l_index.shape[1]):
        local[:, j, j] += effect_curvature[l_index[:, j]]
    return _System(
        (weighted * score[:, :n]).sum(0) + prior_gradient[g_index],
        score[:, n:] + prior_gradient[l_index],
        curvature,
        cross,
        local,
    )


def positive(matrix: np.ndarray) -> np.ndarray:
    """Nearest curvature with eigenvalues bounded away from zero, for symmetric matrices (..., n, n) of any units."""
    if matrix.shape[-1] == 0:
        return matrix
    symmetric = (matrix + np.swapaxes(matrix, -1, -2)) / 2
    size = np.sqrt(np.maximum(np.abs(np.einsum("...ii->...i", symmetric)), 1e-300))
    outer = size[..., :, None] * size[..., None, :]
    values, vectors = np.linalg.eigh(symmetric / outer)
    values = np.maximum(np.abs(values), 1e-12)
    return np.einsum("...ij,...j,...kj->...ik", vectors, values, vectors) * outer


def _step(
    system: _System, active: Active, damping: float, fix_global: bool
) -> tuple[np.ndarray, np.ndarray, float]:
    """Damped Newton step by the Schur complement of the local coordinates; also the predicted gain."""
    local = positive(system.local)
    if local.shape[-1]:
        local = local + damping * np.einsum("cii->ci", local)[:, :, None] * np.eye(local.shape[-1])
    solve = (
        np.linalg.solve(local, system.local_gradient[..., None])[..., 0]
        if local.shape[-1]
        else system.local_gradient
    )
    if fix_global or not len(system.gradient):
        step, local_step = np.zeros(len(system.gradient)), solve
    else:
        weight = active.weights
        eliminated = np.linalg.solve(local, np.swapaxes(system.cross, 1, 2)) if local.shape[-1] else None
        schur, gradient = system.curvature, system.gradient
        if eliminated is not None:
            schur = schur - np.einsum("c,cij,cjk->ik", weight, system.cross, eliminated)
            gradient = gradient - np.einsum("c,cij,cj->i", weight, system.cross, solve)
        schur = positive(schur) + damping * np.diag(np.maximum(np.diag(schur), 1e-12))
        size = np.sqrt(np.maximum(np.diag(schur), 1e-300))
        step = linalg.solve(schur / np.outer(size, size), gradient / size, assume_a="pos") / size
        local_step = solve if eliminated is None else solve - np.einsum("cij,j->ci", eliminated, step)
    gain = (
        float(system.gradient @ step + (active.weights[:, None] * system.local_gradient * local_step).sum())
        / 2
    )
    return step, local_step, gain


def _objective(problem: Problem, active: Active, x: np.ndarray) -> np.ndarray:
    """Log posterior as one global entry followed by one per cluster, without weights."""
    likelihood, prior, local = (np.asarray(v) for v in problem.compiled.evaluate(x))
    extra, _, _ = effect_prior(problem, active, x)
    return np.concatenate([[float(prior) + extra], likelihood + local])


def _weighted(active: Active, terms: np.ndarray) -> float:
    value = terms[0] + float(active.weights @ np.where(active.weights > 0, terms[1:], 0.0))
    return value if np.isfinite(value) else -np.inf


def fit(
    problem: Problem,
    x: np.ndarray,
    effects: Sequence[str] = (),
    *,
    weights: np.ndarray | None = None,
    steps: int = 40,
    tolerance: float = 1e-3,
    spread: float = 0.1,
) -> Fit:
    """Posterior mode from the starting point x.

    Args:
        problem: the model and candidates on their data.
        x: flat vector to start from; coordinates of effects that are not free stay as they are.
        effects: names of the effects that are free.
        weights: per cluster, 0 leaves it out of the fit.
        steps: at most so many Gauss-Newton steps.
        tolerance: stop when the predicted gain in nats falls below.
        spread: first standard deviation of variance effects' fields.
    """
    active = activate(problem, effects, weights, spread)
    x, damping, converged = np.array(x, float), 1e-3, False
    value = _weighted(active, _objective(problem, active, x))
    for _ in range(steps):
        system = _system(problem, active, x)
        accepted = False
        for _ in range(8):
            step, local_step, gain = _step(system, active, damping, fix_global=False)
            trial = _clip(problem, active, _moved(active, x, step, local_step))
            trial_value = _weighted(active, _objective(problem, active, trial))
            if trial_value > value:
                accepted = True
                break
            damping = max(4 * damping, 1e-6)
            if gain < tolerance:
                break
        converged = gain < tolerance or (not accepted and damping > 1e3)
        if accepted:
            x, value, damping = trial, trial_value, damping / 8
            active, value = _respread(problem, active, x, system, value)
        if converged or not accepted:
            break
    return _finish(problem, active, x, value, converged)


def _moved(active: Active, x: np.ndarray, step: np.ndarray, local_step: np.ndarray) -> np.ndarray:
    x = x.copy()
    x[active.global_index] += step
    if local_step.size:
        x[active.local_index] += local_step
    return x


def _clip(problem: Problem, active: Active, x: np.ndarray) -> np.ndarray:
    """Keep one-sided effect parameters on their side of the null."""
    for effect in active.effects:
        for parameter in effect.parameters if effect.kind == "mean" else ():
            if parameter.is_one_sided:
                block = problem.layout[effect.site_name(parameter.name)]
                x[block.index[0]] = np.maximum(x[block.index[0]], parameter.null)
    return x


def _respread(
    problem: Problem, active: Active, x: np.ndarray, system: _System, value: float
) -> tuple[Active, float]:
    """EM update of the standard deviations of variance effects: second moment of the field under its posterior."""
    if not active.spread:
        return active, value
    spread = dict(active.spread)
    l_index = active.local_index
    posterior = np.linalg.inv(positive(system.local)) if l_index.shape[1] else None
    for effect in active.effects:
        if effect.kind != "variance":
            continue
        moments = []
        for block in problem.blocks_of(effect.name):
            variance = np.zeros(block.index.shape)
            if block.local and posterior is not None:
                position = {int(i): j for j, i in enumerate(l_index[0])}
                columns = [position[int(i)] for i in block.index[0]]
                variance = np.einsum("cii->ci", posterior)[:, columns]
            moments.append(
                (x[block.index] ** 2 + variance)[active.weights > 0] if block.local else x[block.index] ** 2
            )
        spread[effect.name] = float(np.sqrt(np.mean(np.concatenate([m.ravel() for m in moments]))) + 1e-9)
    active = replace(active, spread=spread)
    return active, _weighted(active, _objective(problem, active, x))


def _finish(problem: Problem, active: Active, x: np.ndarray, value: float, converged: bool) -> Fit:
    system = _system(problem, active, x)
    local = positive(system.local)
    schur = system.curvature
    n_local = local.shape[-1]
    evidence = value + 0.5 * (len(active.global_index) + n_local * active.weights.sum()) * _LOG_2PI
    if n_local:
        eliminated = np.linalg.solve(local, np.swapaxes(system.cross, 1, 2))
        schur = schur - np.einsum("c,cij,cjk->ik", active.weights, system.cross, eliminated)
        evidence -= 0.5 * float(active.weights @ np.linalg.slogdet(local)[1])
    schur = positive(schur)
    evidence -= 0.5 * float(np.linalg.slogdet(schur)[1]) if len(schur) else 0.0
    covariance = np.linalg.inv(schur) if len(schur) else schur
    evidence += sum(_mixed(problem, active, x, covariance, e) for e in active.effects if e.kind == "mean")
    names = tuple(e.name for e in active.effects)
    return Fit(x, names, active.spread, value, evidence, covariance, active.global_index, converged)


def _mixed(problem: Problem, active: Active, x: np.ndarray, covariance: np.ndarray, effect: Effect) -> float:
    """What mixing the scale of an effect's prior adds to the log evidence."""
    blocks = [problem.layout[effect.site_name(p.name)] for p in effect.parameters]
    index = np.concatenate([b.index[0] for b in blocks])
    place = [int(np.flatnonzero(active.global_index == i)[0]) for i in index]
    null = np.concatenate([np.full(b.size, p.null) for b, p in zip(blocks, effect.parameters, strict=True)])
    scale = np.concatenate([(prior_scale(p.prior) * np.ones(p.shape)).reshape(-1) for p in effect.parameters])
    sided = len(index) == 1 and effect.parameters[0].is_one_sided
    return mixing_gain(covariance[np.ix_(place, place)], x[index] - null, scale, one_sided=sided)


def marginal(problem: Problem, fitted: Fit, *, steps: int = 20) -> np.ndarray:
    """Log marginal likelihood of each cluster (cluster,) given the fit's global coordinates.

    Local coordinates are refitted per cluster and integrated out by Laplace's method, so that clusters that the fit has
    not seen are judged fairly.
    """
    active = activate(problem, fitted.effects)
    active = replace(active, spread=fitted.spread)
    x = fitted.x.copy()
    if not active.local_index.shape[1]:
        return _objective(problem, active, x)[1:]
    terms = _cluster_terms(problem, active, x)
    damping = np.float64(1e-3)
    for _ in range(steps):
        system = _system(problem, active, x)
        _, local_step, gain = _step(system, active, float(damping), fix_global=True)
        trial = _moved(active, x, np.zeros(len(active.global_index)), local_step)
        new = _cluster_terms(problem, active, trial)
        better = new > terms
        x[active.local_index[better]] = trial[active.local_index[better]]
        terms = np.where(better, new, terms)
        damping = damping / 4 if better.all() else damping * 4
        if gain < 1e-3 * problem.n_cluster:
            break
    local = positive(_system(problem, active, x).local)
    return terms + 0.5 * local.shape[-1] * _LOG_2PI - 0.5 * np.linalg.slogdet(local)[1]


def _cluster_terms(problem: Problem, active: Active, x: np.ndarray) -> np.ndarray:
    """Log likelihood and local prior of each cluster."""
    terms = _objective(problem, active, x)[1:]
    for name, sd in active.spread.items():
        for block in problem.blocks_of(name):
            if block.local:
                w = x[block.index]
                terms = terms - 0.5 * (w**2).sum(1) / sd**2 - block.size * (np.log(sd) + 0.5 * _LOG_2PI)
    return terms
