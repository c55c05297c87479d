"""Ways for a perturbation to vary along an axis: smoothly, and with each data column that lies along it."""

from __future__ import annotations

import equinox as eqx
import numpy as np

from dtprob.gap.problem import Problem

_SMOOTH_FROM = 6
_ORDER = 4


def curves(problem: Problem, axis: str, size: int) -> dict[str, np.ndarray]:
    """Curves (curve, size) along an axis by family name; none where the axis is short."""
    if size < _SMOOTH_FROM:
        return {}
    position = (np.arange(size) + 0.5) / size
    found = {f"smooth in {axis}": np.cos(np.pi * np.outer(np.arange(1, _ORDER + 1), position))}
    observed = problem.declaration.observed.values()
    if not any(axis in site.axes for site in observed):
        return found
    arguments = {site.argument for site in observed}
    for name, values in problem.data.items():
        if name in arguments or not eqx.is_array_like(values):
            continue
        column = np.asarray(values)
        if column.shape == (size,) and np.issubdtype(column.dtype, np.floating) and column.std() > 0:
            z = (column - column.mean()) / column.std()
            found[f"along {name}"] = np.stack([z, z**2 - 1.0])
    return found
