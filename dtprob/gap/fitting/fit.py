"""Gauss-Newton refits of any subset of coordinates, with cluster-local ones eliminated cluster by cluster.

A fit finds the posterior mode of the global nuisances, the local ones, the parameters of chosen effects and the fields of
chosen variance effects (whose standard deviations are re-estimated at every step). The curvature is the Fisher information
plus the prior's, so the log evidence (Laplace) and the marginal log likelihood of each cluster come with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.active import LOG_2PI, Active, activate
from dtprob.gap.fitting.density import (
    cluster_terms,
    curved,
    farthest,
    moved,
    rescored,
    system_at,
    value_of,
    volume_of,
)
from dtprob.gap.fitting.newton import NewtonStep, System, newton_step
from dtprob.gap.fitting.plausible import mixing_gain, nulls, places, scales, sides
from dtprob.gap.fitting.spread import Changes, respread
from dtprob.gap.model.problem import Problem
from dtprob.gap.model.volume import Volume

_TRIES: Final = 8
_SETTLED: Final = 0.01
"""Change of the logarithm of a field's standard deviation below which it stands."""
_PATIENCE: Final = 8
"""Gauss-Newton steps with new curvatures that may not have arrived."""
_FIRST_DAMPING: Final = 1e-3
_LEAST_DAMPING: Final = 1e-12
_AS_PROMISED: Final = (0.6, 1.4)
"""Share of a promised gain that shows that curvatures still hold, so that a gradient is all that the next step needs."""
_ALIKE: Final = 0.5
"""Change of the logarithm of a field's standard deviation up to which they may."""
_CHEAP: Final = 0.25
"""What a step with kept curvatures counts for among the steps of a fit."""
_AT_NULL: Final = 1e-6
"""Standard deviations of its prior within which a size is at its null."""
_STUCK: Final = 1e3
"""Damping beyond which a fit has arrived, whatever its quadratic promises."""


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
        volume: what integrating unknowns out adds about this mode, where another expansion than the problem's was needed.
    """

    x: np.ndarray
    effects: tuple[str, ...]
    spread: dict[str, float]
    log_posterior: float
    log_evidence: float
    covariance: np.ndarray
    global_index: np.ndarray
    converged: bool
    volume: Volume | None = None

    def within(self, problem: Problem) -> Problem:
        """The problem with the expansion about this mode."""
        return problem if self.volume is None else problem.with_volume(self.volume)


@np.errstate(over="ignore", invalid="ignore")  # bad starting points lead far out
def fit(
    problem: Problem,
    x: np.ndarray,
    effects: Sequence[str] = (),
    *,
    weights: np.ndarray | None = None,
    steps: float = 40,
    tolerance: float = 1e-3,
    spread: Mapping[str, float] = MappingProxyType({}),
) -> Fit:
    """Posterior mode from the starting point x.

    Args:
        problem: the model and candidates on their data.
        x: flat vector to start from; coordinates of effects that are not free stay as they are.
        effects: names of the effects that are free.
        weights: per cluster, 0 leaves it out of the fit.
        steps: at most so many, those that keep the last curvatures counting for a quarter. They are Gauss-Newton steps, and
            where clusters have unknowns of their own Newton steps once some of these have not arrived.
        tolerance: stop when the predicted gain in nats falls below.
        spread: first standard deviation of variance effects' fields by name; see `activate`.
    """
    active = activate(problem, effects, weights, spread)
    x, damping, converged = np.array(x, float), _FIRST_DAMPING, False
    value = value_of(problem, active, x)
    if value == -np.inf and not np.isfinite(problem.compiled.residual(x)).all():
        return _hopeless(active, x)
    latest: Changes = {}
    last: System | None = None
    patience, may_curve = _PATIENCE, bool(active.local_index.size)
    while steps > 0:
        fresh = last is None
        steps -= 1 if fresh else _CHEAP
        system = system_at(problem, active, x) if last is None else rescored(problem, active, x, last)
        if not system.finite:
            return _hopeless(active, x)
        patience -= fresh
        is_curved = may_curve and patience < 0
        solved = curved(problem, active, x, system) if is_curved and fresh else system
        trial = _better(problem, active, solved, x, value=value, damping=damping, tolerance=tolerance)
        gained = trial.value - value
        better = gained > 0
        converged = trial.gain < tolerance or (not better and trial.damping > _STUCK)
        if better:
            x, value = _guarded(problem, active, x, trial.x), trial.value
            damping = max(trial.damping / 8, _LEAST_DAMPING)
        elif trial.gain >= tolerance:
            damping = trial.damping
        change = 0.0
        # by curvatures of one kind: by those of the other the spread would be another
        if active.spread and (fresh or not is_curved):
            active, change, latest = respread(problem, active, x, system, latest)
            value = value_of(problem, active, x)
        converged = converged and change < _SETTLED
        ends = converged or not (better or change >= _SETTLED)
        if ends and fresh:  # kept curvatures may promise too little where they have fallen since
            if converged:
                break
            if may_curve and patience >= 0:
                patience, damping = 0, _FIRST_DAMPING
        as_promised = _AS_PROMISED[0] * trial.gain < gained < _AS_PROMISED[1] * trial.gain
        last = solved if as_promised and not ends and change < _ALIKE else None
    return _finish(problem, active, x, value, converged)


def _hopeless(active: Active, x: np.ndarray) -> Fit:
    """The fit of a starting point that leads where the model or its derivatives are not finite."""
    index, names = active.global_index, tuple(e.name for e in active.effects)
    return Fit(x, names, active.spread, -np.inf, -np.inf, np.eye(len(index)), index, False)


def _guarded(problem: Problem, active: Active, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The point after a step, own unknowns of clusters that are left out where these are better off.

    Nothing else judges how far they go.
    """
    index = active.local_index[active.weights == 0]
    if not index.size:
        return after
    held = after.copy()
    held[index] = before[index]
    stay, go = (cluster_terms(problem, active, x)[active.weights == 0] for x in (held, after))
    held[index[go > stay]] = after[index[go > stay]]
    return held


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
    lowest, longest = lowest_steps(problem, active, x), farthest(problem)[active.global_index]
    trial = _Trial(x, value, 0.0, damping)
    for _ in range(_TRIES):
        step = newton_step(system, damping, lowest)
        share = min(1.0, 1.0 / float(np.max(np.abs(step.shared) / longest, initial=1e-300)))
        shifted = moved(problem, active, x, NewtonStep(share * step.shared, share * step.local, step.gain))
        trial = _Trial(shifted, value_of(problem, active, shifted), step.gain, damping)
        if trial.value > value:
            break
        damping = max(4 * damping, 1e-6)
        trial = trial._replace(damping=damping)
        if step.gain < tolerance:
            break
    return trial


def lowest_steps(problem: Problem, active: Active, x: np.ndarray) -> np.ndarray:
    """The smallest step of each global coordinate: one-sided parameters stay on their side of the null."""
    lowest = np.full(len(x), -np.inf)
    for effect in active.effects:
        if effect.kind == "mean":
            index = problem.layout.of(effect)
            lowest[index] = np.where(sides(effect), nulls(effect) - x[index], -np.inf)
    return lowest[active.global_index]


def _finish(problem: Problem, active: Active, x: np.ndarray, value: float, converged: bool) -> Fit:
    system = system_at(problem, active, x)
    if not system.finite:
        return _hopeless(active, x)
    local, schur = system.eliminated()
    if not np.isfinite(schur).all():
        return _hopeless(active, x)
    evidence = value - volume_of(problem, active, x)  # told anew, not expanded
    evidence += 0.5 * (len(active.global_index) + local.shape[-1] * active.weights.sum()) * LOG_2PI
    evidence -= 0.5 * float(active.weights @ np.linalg.slogdet(local)[1]) if local.shape[-1] else 0.0
    evidence -= 0.5 * float(np.linalg.slogdet(schur)[1]) if len(schur) else 0.0
    covariance = np.linalg.inv(schur) if len(schur) else schur
    pushed = pushed_out(problem, active, x, system.gradient)
    evidence += 0.5 * float(pushed @ covariance @ pushed)
    beyond = x.copy()
    beyond[active.global_index] += covariance @ pushed
    for effect in (e for e in active.effects if e.kind == "mean"):
        index = problem.layout.of(effect)
        place = np.searchsorted(active.global_index, index)
        evidence += _mixed(effect, beyond[index], covariance[np.ix_(place, place)])
    names = tuple(e.name for e in active.effects)
    return Fit(x, names, active.spread, value, evidence, covariance, active.global_index, converged)


def pushed_out(problem: Problem, active: Active, x: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Slope (global,) of the log posterior at sizes that it pushes below a null that they cannot be below; 0 elsewhere.

    With curvature H the mode of its quadratic lies H^-1 times that farther out, half the slope times that higher.
    """
    pushed = np.zeros(len(active.global_index))
    for effect in (e for e in active.effects if e.kind == "mean"):
        index = problem.layout.of(effect)
        place = np.searchsorted(active.global_index, index)
        edge = sides(effect) & ~places(effect) & (x[index] - nulls(effect) <= _AT_NULL * scales(effect))
        pushed[place] = np.where(edge, np.minimum(gradient[place], 0.0), 0.0)
    return pushed


def _mixed(effect: Effect, mode: np.ndarray, covariance: np.ndarray) -> float:
    """What mixing the scale of an effect's prior adds to the log evidence; the quadratic's mode may be out of range."""
    change = mode - nulls(effect)
    return mixing_gain(covariance, change, scales(effect), sides=sides(effect), places=places(effect))
