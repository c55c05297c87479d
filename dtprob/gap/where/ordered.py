"""Ways to vary along a site in the order of its positions: cycles, stretches, blocks, and the courses of groups."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy import sparse

from dtprob.gap.where.curves import OWN_TURNS, Curves, cycles, stretches

_ROWS: Final = 8
"""Positions of a second axis from which rows may follow one another from cluster to cluster."""
COLUMNS: Final = 16
"""Entries of a last axis up to which each is looked at."""
_MOST_OF_EACH: Final = 1 << 16
"""Entries of a site of which stretches, and what repeats in each cluster, are looked at."""
_MOST_BLOCKS: Final = 1 << 13
"""Stretches of one axis by those of another that are looked at."""
_MOST_CELLS: Final = 512
_CELL: Final = 2
"""Groups of one axis by positions of another that are looked at, and entries in each that they have at least."""

type Along = Callable[[str, int], Sequence[Curves]]
"""(axis, its size) -> the curves along it."""
type Found = Iterator[tuple[tuple[int, ...], Curves]]
"""Axes that are kept, and curves along them together."""


def in_order(along: Along, axes: Sequence[str], shape: Sequence[int]) -> Found:
    """All of them.

    Args:
        along: the curves along an axis of a size.
        axes: of the site.
        shape: of the site.
    """
    yield from _cycles(axes, shape)
    yield from _stretches(axes, shape)
    if len(shape) == 2 and np.prod(shape) <= _MOST_OF_EACH:
        yield from _courses(along, axes, shape)
        for found in along(axes[1], shape[1]) if 1 < shape[0] <= COLUMNS else ():
            if found.extent[0] * shape[0] <= _MOST_BLOCKS:
                yield (0, 1), _of_each(found, axes[0], shape[0])


def alike_and_by_last(found: Curves, i: int, axes: Sequence[str], shape: Sequence[int], most: int) -> Found:
    """Curves along an axis, all else alike, and up to `most` of them for each entry of a short last axis, too."""
    yield (i,), found
    last = len(shape) - 1
    if i < last and 1 < shape[last] <= COLUMNS and found.extent[0] <= most:
        yield (i, last), replace(found, label=f"{found.label} x {axes[last]}")


def _cycles(axes: Sequence[str], shape: Sequence[int]) -> Found:
    """What repeats along an axis, or along the rows of all clusters in their order, entry by entry of the other axes."""
    for i, axis in enumerate(axes):
        for found in cycles(shape[i], axis):
            yield (i,), found
    if len(shape) > 1 and shape[1] >= _ROWS and np.prod(shape[2:]) <= COLUMNS:
        for found in cycles(shape[0] * shape[1], f"{axes[0]} and {axes[1]}"):
            yield tuple(range(len(shape))), found
    if len(shape) == 2 and np.prod(shape) <= _MOST_OF_EACH:
        for found in cycles(shape[1], axes[1], turns=OWN_TURNS):
            yield (0, 1), _of_each(found, axes[0], shape[0])


def _stretches(axes: Sequence[str], shape: Sequence[int]) -> Found:
    """Stretches of an axis of several, all else alike or by the last; of the last of two also by positions of the first."""
    last = len(shape) - 1
    for i, axis in enumerate(axes) if last > 0 else ():
        for found in stretches(shape[i], axis):
            yield from alike_and_by_last(found, i, axes, shape, _MOST_BLOCKS // shape[last])
    if len(shape) not in (1, 2) or int(np.prod(shape)) > _MOST_OF_EACH:
        return
    for found in stretches(shape[-1], axes[-1]):
        if len(shape) == 1:
            yield (0,), found
            continue
        yield (0, 1), _of_each(found, axes[0], shape[0])
        for first in stretches(shape[0], axes[0]):
            if first.extent[0] * found.extent[0] <= _MOST_BLOCKS:
                blocks = sparse.csr_matrix(sparse.kron(first.values, found.values))
                label = f"block of {axes[0]} and {axes[1]}"
                yield (0, 1), Curves(label, blocks, overlaps=True, places=_pairs(first, found))


def _courses(along: Along, axes: Sequence[str], shape: Sequence[int]) -> Found:
    """Along one axis, what the groups of the other do in its course: at each position, in stretches, and smoothly."""
    for own, over in ((0, 1), (1, 0)):
        groups = [found for found in along(axes[own], shape[own]) if found.column is not None]
        for group in groups:
            cells = group.extent[0] * shape[over]
            if cells <= _MOST_CELLS and _CELL * cells <= np.prod(shape):
                at = tuple(f"{axes[over]} {k}" for k in range(shape[over]))
                each = Curves("", sparse.csr_matrix(sparse.identity(shape[over])), places=at)
                yield (0, 1), _beside(f"{group.label} x {axes[over]}", group, each, is_first=own == 0)
            for some in stretches(shape[over], axes[over]):
                if group.extent[0] * some.extent[0] <= _MOST_BLOCKS:
                    found = _beside(f"{some.label} {group.label}", group, some, is_first=own == 0)
                    yield (0, 1), replace(found, plain=False, overlaps=True)
            for smooth in along(axes[over], shape[over])[:1]:
                label = f"{smooth.label} {group.label}"
                yield (0, 1), _beside(label, group, smooth, is_first=own == 0)


def _beside(label: str, group: Curves, course: Curves, *, is_first: bool) -> Curves:
    """Every group with every curve of a course, the groups along the first axis or along the second."""
    first, second = (group, course) if is_first else (course, group)
    crossed = sparse.csr_matrix(sparse.kron(first.values, second.values))
    places = _pairs(first, second) if first.places and second.places else ()
    return Curves(label, crossed, plain=True, places=places)


def _pairs(first: Curves, second: Curves) -> tuple[str, ...]:
    return tuple(f"{one}, {other}" for one, other in itertools.product(first.places, second.places))


def _of_each(curves: Curves, axis: str, size: int) -> Curves:
    """Curves along the last of a site's two axes, each position of the first with weights of its own."""
    each = sparse.csr_matrix(sparse.kron(sparse.identity(size), curves.values))
    places = tuple(f"{axis} {i}, {place}" for i in range(size) for place in curves.places)
    return Curves(
        f"{curves.label} x {axis}",
        each,
        says_where=curves.says_where,
        overlaps=curves.overlaps,
        places=places,
    )
