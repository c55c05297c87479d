"""Ways for a perturbation to vary along an axis: smoothly, as a ripple, with the data's columns, or by their groups."""

from __future__ import annotations

import itertools
from typing import Final, cast

import equinox as eqx
import numpy as np
from scipy import sparse, stats

from dtprob.gap.problem import Problem

_SMOOTH_FROM: Final = 6
_ORDER: Final = 4
"""Half waves of what counts as smooth."""
_FINEST: Final = 512
"""Half waves of the finest ripple that is looked for."""
_CROSSED: Final = 3
"""Half waves along each of two columns of what varies over both."""
_MOST_PAIRS: Final = 6
_LONGEST: Final = 24
"""Period of the longest cycle that is looked for; longer ones show as ripples."""
_TURNS: Final = 24
"""Times that a cycle has to come round: sums of a few entries are far from normal."""

type Curve = np.ndarray | sparse.csr_matrix
type Curves = dict[str, Curve]


def extent(curve: Curve) -> tuple[int, int]:
    """How many weights curves have, and along how many positions they run."""
    weights, size = cast("tuple[int, int]", curve.shape)
    return weights, size


def curves(problem: Problem, axis: str, size: int) -> Curves:
    """Curves (curve, size) along an axis by family name; none where the axis is short."""
    if size < _SMOOTH_FROM:
        return {}
    place = (np.arange(size) + 0.5) / size
    found = {f"smooth in {axis}": _waves(place, 1, _ORDER), **_ripples(axis, place)}
    columns = _columns(problem, axis, size)
    for name, column in columns.items():
        groups, index = np.unique(column, return_inverse=True)
        if np.issubdtype(column.dtype, np.floating) or 2 * len(groups) > size:
            found[f"along {name}"] = _waves(_rank(column), 1, _ORDER)
            found |= _ripples(name, (column - column.min()) / np.ptp(column))
        else:
            found[f"by {name}"] = sparse.csr_matrix((np.ones(size), (index, np.arange(size))))
    smooth = [name for name, column in columns.items() if np.issubdtype(column.dtype, np.floating)]
    for one, other in list(itertools.combinations(smooth, 2))[:_MOST_PAIRS]:
        crossed = _waves(_rank(columns[one]), 1, _CROSSED), _waves(_rank(columns[other]), 1, _CROSSED)
        products = crossed[0][:, None] * crossed[1][None]
        found[f"over {one} and {other}"] = products.reshape(-1, size)
    return found


def cycles(size: int) -> dict[int, sparse.csr_matrix]:
    """For each period, the phases (phase, size) of an axis at which something may repeat; none where it is short."""
    place = np.arange(size)
    return {
        period: sparse.csr_matrix((np.ones(size), (place % period, place)))
        for period in range(2, min(_LONGEST, size // _TURNS) + 1)
    }


def _ripples(name: str, place: np.ndarray) -> Curves:
    """Octaves of ripples over places (size,) in (0, 1), by family name."""
    found, low, finest = {}, _ORDER + 1, min(len(place) - 1, _FINEST)
    while low <= finest:
        high = min(2 * (low - 1), finest)
        found[f"ripple in {name}, {low} to {high} half waves"] = _waves(place, low, high)
        low = high + 1
    return found


def _waves(place: np.ndarray, low: int, high: int) -> np.ndarray:
    """Cosines of low to high half waves over places (size,) in (0, 1)."""
    return np.cos(np.pi * np.outer(np.arange(low, high + 1), place))


def _rank(column: np.ndarray) -> np.ndarray:
    """Ranks (size,) in (0, 1), so that a few far values do not bend the curves."""
    return (stats.rankdata(column) - 0.5) / len(column)


def _columns(problem: Problem, axis: str, size: int) -> dict[str, np.ndarray]:
    """Columns of the data (size,) that lie along an axis of the observations and vary; of positions each coordinate."""
    observed = problem.declaration.observed.values()
    if not any(axis in site.axes for site in observed):
        return {}
    arguments = {site.argument for site in observed}
    found: dict[str, np.ndarray] = {}
    for name, values in problem.data.items():
        if name in arguments or not eqx.is_array_like(values):
            continue
        column = np.asarray(values)
        if column.shape == (size,):
            found[name] = column
        elif column.ndim == 2 and column.shape[0] == size and column.shape[1] <= 3:
            found |= {f"{name}[{i}]": part for i, part in enumerate(column.T)}
    real = (np.floating, np.integer, np.bool_)
    return {
        name: column
        for name, column in found.items()
        if any(np.issubdtype(column.dtype, kind) for kind in real) and len(np.unique(column)) > 1
    }
