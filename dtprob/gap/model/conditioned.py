"""Which sites are computed from what was observed, so that they know its errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import jax.numpy as jnp
import numpy as np

from dtprob.gap.model.problem import Problem

_PROBES: Final = 8


def conditioned(problem: Problem, x: np.ndarray) -> frozenset[str]:
    """Deterministic sites that an observed entry moves at its own place or before: a power that a rate is computed from.

    What only later entries hear of, as a filter's prediction, is not among them: it does not know the errors that judge it.

    Args:
        problem: the model on its data.
        x: a flat vector (dimension,).
    """
    names, rng = problem.declaration.deterministic, np.random.default_rng(0)
    before = {n: np.asarray(v) for n, v in problem.compiled.sites(x).items() if n in names}
    found: set[str] = set()
    for argument in sorted(problem.observed.arguments):
        own = np.asarray(problem.data[argument])
        drawn = rng.choice(own.reshape(-1), own.size).reshape(own.shape)
        moved = {n for n, m in _moved(problem, x, before, {argument: drawn}).items() if m.any()} - found
        for place in rng.choice(own.size, min(_PROBES, own.size), replace=False) if moved else ():
            other = own.reshape(-1).copy()
            other[place] = other[np.argmax(other != other[place])]
            changed = _moved(problem, x, before, {argument: other.reshape(own.shape)})
            found |= {n for n in moved if _knows(changed[n], place, own.size)}
    return frozenset(found)


def _moved(
    problem: Problem, x: np.ndarray, before: Mapping[str, np.ndarray], given: Mapping[str, Any]
) -> dict[str, np.ndarray]:
    """Where sites have other values with other data, flattened."""
    after = problem.compiled.sites(x, {name: jnp.asarray(value) for name, value in given.items()})
    return {n: (np.asarray(after[n]) != value).reshape(-1) for n, value in before.items()}


def _knows(changed: np.ndarray, place: int, size: int) -> bool:
    """Whether a site has changed at an observed entry's own place or before it; anywhere, if their places do not match."""
    return bool(changed[: place + 1].any() if len(changed) == size else changed.any())
