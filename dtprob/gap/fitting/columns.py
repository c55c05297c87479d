"""Products of whitened rows (..., cluster, row) with columns (cluster, row, i), of all clusters together or of each one."""

from __future__ import annotations

import numpy as np


def scores(columns: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Products (..., i) of columns (cluster, row, i) with rows (..., cluster, row)."""
    entries = columns.shape[0] * columns.shape[1]
    return e.reshape(*e.shape[:-2], entries) @ columns.reshape(entries, columns.shape[-1])


def rows_of(columns: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Rows (..., cluster, row) that steps (..., i) of columns (cluster, row, i) make."""
    entries = columns.shape[0] * columns.shape[1]
    moved = steps @ columns.reshape(entries, columns.shape[-1]).T
    return moved.reshape(*steps.shape[:-1], *columns.shape[:-1])


def rows_of_each(columns: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Rows (..., cluster, row) that steps (..., cluster, i) of columns (cluster, row, i) make, cluster by cluster."""
    moved = np.moveaxis(apart(steps) @ np.swapaxes(columns, 1, 2), 0, -2)
    return moved.reshape(*steps.shape[:-1], columns.shape[1])


def apart(values: np.ndarray) -> np.ndarray:
    """Values (..., cluster, i) as (cluster, n, i)."""
    n = int(np.prod(values.shape[:-2], dtype=int))
    return np.moveaxis(values, -2, 0).reshape(values.shape[-2], n, values.shape[-1])


def product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Sum over clusters and rows of columns (cluster, row, i) times columns (cluster, row, j)."""
    entries = left.shape[0] * left.shape[1]
    return left.reshape(entries, left.shape[-1]).T @ right.reshape(entries, right.shape[-1])


def scores_of_each(columns: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Products (..., cluster, i) of columns (cluster, row, i) with rows (..., cluster, row), cluster by cluster."""
    found = np.moveaxis(apart(e) @ columns, 0, -2)
    return found.reshape(*e.shape[:-1], columns.shape[2])
