"""Half-overlapping windows of several lengths: of positions in their order, of a column's values, within groups."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import sparse

_CELLS: Final = 64
"""Parts of equal share that a column's values are cut into, of which windows are made."""


def windows(size: int) -> tuple[sparse.csr_matrix, list[tuple[int, int]]]:
    """Windows of 2, 4, 8 ... of some positions: which (window, position) lie in each, and where each begins and stops."""
    lengths = [2**k for k in range(1, int(np.log2(size)))]
    ends = [(low, low + n) for n in lengths for low in range(0, size - n + 1, n // 2)]
    weight = np.repeat(np.arange(len(ends)), [stop - low for low, stop in ends])
    position = np.concatenate([np.arange(*window) for window in ends])
    return sparse.csr_matrix((np.ones(len(weight)), (weight, position)), (len(ends), size)), ends


def windows_of_values(column: np.ndarray, fewest: int) -> tuple[sparse.csr_matrix, list[tuple[float, float]]]:
    """Windows of the values of a column (size,), of as many positions each as others of their length, ties together.

    Args:
        column: the values.
        fewest: cells that they are cut into at least; there are no windows where their values part them into fewer.
    """
    cuts = np.unique(np.quantile(column, np.arange(1, _CELLS) / _CELLS, method="inverted_cdf"))
    distinct, cell = np.unique(np.searchsorted(cuts, column), return_inverse=True)
    if len(distinct) < fewest:
        return sparse.csr_matrix((0, len(column))), []
    chosen, ends = windows(len(distinct))
    in_cell = sparse.csr_matrix((np.ones(len(cell)), (cell, np.arange(len(cell)))))
    lowest = [float(column[cell == i].min()) for i in range(len(distinct))]
    highest = [float(column[cell == i].max()) for i in range(len(distinct))]
    return sparse.csr_matrix(chosen @ in_cell), [(lowest[low], highest[stop - 1]) for low, stop in ends]


def within(groups: sparse.csr_matrix, some: sparse.csr_matrix) -> sparse.csr_matrix:
    """What lies in each group (group, position) and each of some windows (window, position), group by group."""
    parts = [some.multiply(group) for group in groups.toarray()]
    found = sparse.csr_matrix(sparse.vstack(parts))
    found.eliminate_zeros()
    return found
