"""All ways for a perturbation to vary along an axis of the data: with its positions, and with the columns along it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from dtprob.gap.model.problem import Problem
from dtprob.gap.where.crossed import (
    MOST_PAIRS,
    along_in_groups,
    by_both,
    in_groups,
    over_both,
    over_plane,
    products,
)
from dtprob.gap.where.curves import (
    GROUPS,
    ORDER,
    SMOOTH_FROM,
    Curves,
    between,
    by_group,
    over_column,
    ripples,
    waves,
)
from dtprob.gap.where.data_columns import columns

_FINEST: Final = 512
"""Half waves of the finest ripple that is looked for."""
_FEW: Final = 8
_COARSE: Final = 32
"""Columns up to which ripples are as fine as that, and half waves of the finest ones over more columns."""
_MOST_PLANES: Final = 66
_MOST_IN_PLANES: Final = 1 << 21
"""Pairs of columns of which what is smooth over both is looked at, and positions times these."""
_SHARED: Final = 8
"""Values of a real column up to which it is looked at by value too, and positions that share one of them on average."""


def curves(problem: Problem, axis: str, size: int) -> tuple[Curves, ...]:
    """All curves along an axis of some positions, each label once; none where the axis is short."""
    if size < SMOOTH_FROM:
        return ()
    # ripples over a column of the axis's name are those over its positions, at their true places
    return tuple({found.label: found for found in _curves(problem, axis, size)}.values())


def _curves(problem: Problem, axis: str, size: int) -> Iterator[Curves]:
    place = (np.arange(size) + 0.5) / size
    yield Curves(f"smooth in {axis}", waves(place, 1, ORDER), simple=True)
    yield from ripples(axis, place, _FINEST)
    found = columns(problem, axis, size)
    made = {n: np.unique(c, return_inverse=True)[1] for n, c in found.items() if _makes_groups(c)}
    by = {n: by_group(n, index, found[n]) for n, index in made.items()}
    for one in _over_columns(found, made, by):
        yield replace(one, of_data=True)
    for group in itertools.islice(by.values(), 0 if axis in found else MOST_PAIRS):
        yield from in_groups(group, *between(f"stretch of {axis}", axis, np.arange(size)))


def _over_columns(
    found: Mapping[str, np.ndarray], made: Mapping[str, np.ndarray], by: Mapping[str, Curves]
) -> Iterator[Curves]:
    """What varies with columns (size,), alone and two together.

    Args:
        found: the columns.
        made: groups (size,) of those that make some.
        by: curves by these groups.
    """
    for name, column in found.items():
        if _is_ordered(column):
            yield from over_column(name, column, _FINEST if len(found) <= _FEW else _COARSE)
        if name in by:
            yield by[name]
    yield from _pairs(found, by)
    yield from itertools.islice(by_both(found, made), MOST_PAIRS)


def _pairs(found: Mapping[str, np.ndarray], by: Mapping[str, Curves]) -> Iterator[Curves]:
    """What varies with two columns (size,) together: smooth over both, along one in each group of the other.

    Args:
        found: the columns.
        by: groups of those that make some.
    """
    smooth = [n for n, c in found.items() if _is_ordered(c) and np.issubdtype(c.dtype, np.floating)]
    size = len(next(iter(found.values()), ()))
    planes = min(_MOST_PLANES, max(_MOST_IN_PLANES // max(size, 1), MOST_PAIRS))
    pairs = list(itertools.islice(itertools.combinations(smooth, 2), planes))
    for i, (one, other) in enumerate(pairs):
        place = np.stack([found[one], found[other]], axis=1)
        yield from over_both((one, other), place) if i < MOST_PAIRS else [over_plane((one, other), place)]
    yield from products(found, pairs)
    for along in (smooth, [n for n, c in found.items() if _is_rising(c)]):
        crossed = [(one, other) for one, other in itertools.product(along, by) if one != other]
        for one, other in crossed[:MOST_PAIRS]:
            yield from along_in_groups(by[other], one, found[one])


def _is_ordered(column: np.ndarray) -> bool:
    """Whether a column (size,) measures something: its values are no names of groups, as few ones or whole numbers are."""
    count = len(np.unique(column))
    if np.issubdtype(column.dtype, np.floating):
        return count >= SMOOTH_FROM
    return 2 * count > len(column)


def _is_rising(column: np.ndarray) -> bool:
    """Whether a column (size,) counts something that passes from position to position, as days do in a log."""
    is_whole = np.issubdtype(column.dtype, np.integer)
    return is_whole and len(np.unique(column)) >= SMOOTH_FROM and bool(np.all(column[1:] >= column[:-1]))


def _makes_groups(column: np.ndarray) -> bool:
    """Whether the values of a column (size,) may be names of groups, as numbers of receivers are among real ones too."""
    count = len(np.unique(column))
    return not _is_ordered(column) or (count <= GROUPS and _SHARED * count <= len(column))
