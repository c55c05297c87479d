"""Columns of the data that lie along the axes of what is observed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import equinox as eqx
import numpy as np

from dtprob.errors import InputError
from dtprob.gap.fitting.soundness import told_bad
from dtprob.gap.model.problem import Problem
from dtprob.models.declaration import Site

_POSITION: Final = 3
_MOST: Final = 32
"""Columns of positions, and of tables of features, up to which each is looked along; wider ones are neither."""


def check_finite(problem: Problem) -> None:
    """Refuse columns with missing values beside readings that count: nothing could be looked for along them.

    One that is whole beside the readings of one observed site may have gaps beside those of another.

    Raises:
        InputError: the first such column.
    """
    lost: dict[str, list[np.ndarray]] = {}
    for name, site in problem.declaration.observed.items():
        counts = problem.observed.counted[name]
        for column, missing in all_columns(problem, site, missing=True).items():
            lost.setdefault(column, []).append(counts & np.broadcast_to(missing, site.shape))
    for column, of_each in lost.items():
        if all(gaps.any() for gaps in of_each):
            remedy = "Fill them, leave those readings out, or give the model no such column"
            expected = "finite numbers beside each reading"
            raise InputError(f"data {column}", expected, told_bad(of_each[0]), remedy)


def columns(problem: Problem, axis: str, size: int, *, missing: bool = False) -> dict[str, np.ndarray]:
    """Columns of the data (size,) that lie along an axis of the observations and vary; of positions or features each.

    Args:
        problem: the model on its data.
        axis: the axis.
        size: entries along it.
        missing: tell where they are not finite, instead.
    """
    if not any(axis in site.axes for site in problem.declaration.observed.values()):
        return {}
    found: dict[str, np.ndarray] = {}
    for name, column in _given(problem, missing=missing):
        if column.shape == (size,):
            found[name] = column
        elif column.ndim == 2 and column.shape[0] == size and _is_table(problem, column.shape):
            found |= {f"{name}[{i}]": part for i, part in enumerate(column.T)}
    real = (np.floating, np.integer, np.bool_)
    return {
        name: column
        for name, column in found.items()
        if any(np.issubdtype(column.dtype, kind) for kind in real) and (missing or len(np.unique(column)) > 1)
    }


def _is_table(problem: Problem, shape: tuple[int, ...]) -> bool:
    """Whether an array (size, n) holds positions or features, not what is known of each entry along two axes."""
    whole = any(_is_within(shape, site.shape) for site in problem.declaration.observed.values())
    return shape[1] <= _POSITION or (shape[1] <= _MOST and not whole)


def whole_columns(problem: Problem, site: Site, *, missing: bool = False) -> dict[str, np.ndarray]:
    """Columns of the data that lie on several axes of an observed site, with an entry for each observation."""
    return {
        name: np.broadcast_to(column, site.shape)
        for name, column in _given(problem, missing=missing)
        if column.ndim > 1 and _is_within(column.shape, site.shape)
    }


def all_columns(problem: Problem, site: Site, *, missing: bool = False) -> dict[str, np.ndarray]:
    """Columns of the data on one axis or several of an observed site, of size 1 along the site's other axes."""
    found = whole_columns(problem, site, missing=missing)
    for i, axis in enumerate(site.axes):
        beside = tuple(j for j in range(len(site.shape)) if j != i)
        for name, column in columns(problem, axis, site.shape[i], missing=missing).items():
            found.setdefault(name, np.expand_dims(column, beside))
    return found


def _is_within(shape: tuple[int, ...], wide: tuple[int, ...]) -> bool:
    """Whether an array of a shape is broadcast to another one."""
    try:
        return np.broadcast_shapes(shape, wide) == wide
    except ValueError:
        return False


def _given(problem: Problem, *, missing: bool) -> Iterator[tuple[str, np.ndarray]]:
    """The arrays of the data, but for what tells what was observed; or where they are not finite.

    What is missing is as the others of its column are on average: only beside readings that do not count may anything be.
    """
    for name, values in problem.data.items():
        if name not in problem.observed.arguments and eqx.is_array_like(values):
            array = np.asarray(values)
            is_real = np.issubdtype(array.dtype, np.inexact)
            lost = ~np.isfinite(array) if is_real else np.zeros(array.shape, bool)
            yield name, lost if missing else _filled(array, lost)


def _filled(array: np.ndarray, lost: np.ndarray) -> np.ndarray:
    if not lost.any():
        return array
    known = np.where(lost, 0.0, array)
    return np.where(lost, known.sum(axis=0) / np.maximum((~lost).sum(axis=0), 1), array)
