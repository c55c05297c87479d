"""How far the fields of variance effects spread: their standard deviations, re-estimated at every step of a fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting.active import Active
from dtprob.gap.fitting.newton import System
from dtprob.gap.fitting.plausible import plausible_spread
from dtprob.gap.model.problem import Problem

_FEWEST: Final = 0.5
_FAINTEST: Final = 1e-9
"""Least standard deviation of a field, as a share of the largest plausible one."""
_FAINT: Final = 1e-2
"""The same below which a field that vanishes is at once as faint as can be."""
_LONGEST: Final = float(np.log(3.0))

type Changes = Mapping[str, float]
"""The last change of the logarithm of each field's standard deviation; empty after one that was extrapolated."""


def respread(
    problem: Problem, active: Active, x: np.ndarray, system: System, latest: Changes
) -> tuple[Active, float, Changes]:
    """New standard deviations of variance effects, the largest change of their logarithms, and the next `latest`.

    sd^2 <- sum x^2 / gamma, gamma = sum (1 - var / sd^2) the number of entries that the data determine (MacKay, Neural
    Computation 4 (1992) 415): the same fixed point as EM, reached in fewer steps. Where a field is weak these steps
    shrink slowly, so every second one is extrapolated to the limit of a geometric series (Aitken). No step is longer
    than a factor of 3, but for the last one of a field that vanishes.
    """
    spread, changes = dict(active.spread), dict[str, float]()
    own = _variances(problem, active, system)
    for effect in (e for e in active.effects if e.kind == "variance"):
        name, block = effect.name, problem.field_of(effect)
        sd = active.spread[name]
        index = (block.index[active.weights > 0] if block.local else block.index).reshape(-1)
        determined = max(float(np.sum(1 - own[index] / sd**2)), _FEWEST)
        step = float(np.log(np.sqrt(np.sum(x[index] ** 2) / determined) / sd + 1e-300))
        shrink = step / latest[name] if latest.get(name) else 0.0
        step = step / (1 - shrink) if 0 < shrink < 1 else step
        plausible = plausible_spread(effect)
        longest = np.inf if determined == _FEWEST and sd < _FAINT * plausible else _LONGEST
        least = _FAINTEST * plausible
        spread[name] = max(sd * float(np.exp(np.clip(step, -longest, _LONGEST))), least)
        changes[name] = float(np.log(spread[name] / sd))
    change = max(abs(c) for c in changes.values())
    return replace(active, spread=spread), change, {} if latest else changes


def _variances(problem: Problem, active: Active, system: System) -> Float[np.ndarray, " dimension"]:
    """Posterior variance of each free coordinate, all others as uncertain as they are."""
    found = np.zeros(problem.dimension)
    local, schur = system.eliminated()
    shared = np.linalg.inv(schur) if np.isfinite(schur).all() else np.zeros_like(schur)
    found[active.global_index] = np.diag(shared)
    if active.local_index.size:
        pull = np.linalg.solve(local, np.swapaxes(system.cross, 1, 2))
        alone = np.einsum("cii->ci", np.linalg.inv(local))
        found[active.local_index] = alone + np.einsum("cij,jk,cik->ci", pull, shared, pull)
    return found
