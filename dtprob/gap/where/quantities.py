"""Quantities of several axes, data or what a model computes, over which a perturbation may vary."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import sparse

from dtprob.gap.where.crossed import MOST_PAIRS, along_in_groups, in_groups, joined, over_both
from dtprob.gap.where.curves import (
    GROUPS,
    ORDER,
    SMOOTH_FROM,
    Curves,
    between,
    by_group,
    cycles,
    grouped,
    groups_in_words,
    over_column,
)
from dtprob.gap.where.ordered import COLUMNS
from dtprob.models.axes import is_unnamed

_LARGEST: Final = 1 << 18
"""Numbers that the curves over one quantity may take in a band."""
_FINEST_OVER: Final = 64
"""Half waves of the finest ripple over a quantity of several axes or a site."""
_OFTEN: Final = 24
"""Times that a quantity takes each of its values, on average, where each of them may be off by an amount of its own."""


@dataclass(frozen=True)
class Quantity:
    """What the model computes or the data tell at positions of some axes, over which a perturbation may vary.

    Attributes:
        name: the site or the column.
        axes: along which it varies.
        values: at their positions.
        ordered: whether its values are more than names: near ones may act alike.
        coded: whether its values stand for others, as numbers of groups do.
        computed: whether the model computes it from its unknowns.
    """

    name: str
    axes: tuple[str, ...]
    values: np.ndarray
    ordered: bool = True
    coded: bool = False
    computed: bool = False

    def kept(self, axes: Sequence[str], shape: Sequence[int]) -> tuple[int, ...] | None:
        """Which of a site's axes are this one's; None where it lies on others."""
        agree = all(a == b or is_unnamed(a) or is_unnamed(b) for a, b in zip(self.axes, axes, strict=False))
        if agree and self.values.shape == tuple(shape):
            return tuple(range(len(shape)))
        place = [axes.index(axis) for axis in self.axes if axis in axes]
        whole = len(place) == len(self.axes) and place == sorted(place)
        return tuple(place) if whole and self.values.shape == tuple(shape[i] for i in place) else None

    def curves(self) -> Iterator[Curves]:
        """Smooth, and ripples over its values; where it takes few, by value, as entries of a table are."""
        for found in self._curves():
            yield replace(found, of_data=not self.computed)

    def _curves(self) -> Iterator[Curves]:
        flat = self.values.reshape(-1)
        if ORDER * flat.size > _LARGEST:
            return
        distinct, index = np.unique(flat, return_inverse=True)
        if _OFTEN * len(distinct) <= flat.size:
            places = groups_in_words(index, {self.name: flat}) if not self.coded else ()
            yield Curves(f"by value of {self.name}", grouped(index), plain=True, places=places)
        if self.ordered:
            yield from over_column(self.name, flat, min(_FINEST_OVER, _LARGEST // flat.size))


def quantity(name: str, axes: Sequence[str], values: np.ndarray) -> Quantity | None:
    """A real site or column, on the axes along which it varies; None where too few of its values differ."""
    if not np.issubdtype(values.dtype, np.floating) or not np.isfinite(values).all():
        return None
    wide = _varies(values)
    values = values[tuple(slice(None) if i in wide else 0 for i in range(values.ndim))]
    if len(np.unique(values)) < SMOOTH_FROM:
        return None
    return Quantity(name, tuple(axes[i] for i in wide), values)


def groups(name: str, axes: Sequence[str], values: np.ndarray) -> Iterator[Quantity]:
    """What a column of whole numbers, or of few others, on several axes tells apart, as what each device did last.

    Each of its values, anywhere and at each position of the last axis, and what it holds along that axis all together.
    """
    if values.ndim < 2 or values.dtype.kind not in "biuf":
        return
    last, (distinct, index) = values.shape[-1], np.unique(values, return_inverse=True)
    few = len(distinct) < SMOOTH_FROM and bool(np.isfinite(distinct).all())
    if len(distinct) < 2 or not (few or values.dtype.kind != "f"):
        return
    yield Quantity(name, tuple(axes), values, ordered=_OFTEN * len(distinct) > values.size)
    each = last * index.reshape(values.shape) + np.arange(last)
    yield Quantity(f"{name} of each {axes[-1]}", tuple(axes), each, ordered=False, coded=True)
    if last > 1:
        _, rows = np.unique(values.reshape(-1, last), axis=0, return_inverse=True)
        whole = rows.reshape(values.shape[:-1])
        yield Quantity(f"{name} of all", tuple(axes[:-1]), whole, ordered=False, coded=True)


def of_each(name: str, axes: Sequence[str], values: np.ndarray) -> Iterator[tuple[Quantity, Curves]]:
    """What stretches of an axis and cycles do where a yes stands at an entry of the last axis: while device 1 sends.

    As of a device that listens for a part of the time only: of others nothing is wrong then.

    Args:
        name: of a column of two values, of which the less common one is the yes.
        axes: cluster, one along which its rows follow one another, and a short one.
        values: of the column.
    """
    distinct, index, count = np.unique(values, return_inverse=True, return_counts=True)
    if values.ndim != 3 or len(distinct) != 2 or values.shape[-1] > COLUMNS:
        return
    yes = int(count.argmin())
    members = (index.reshape(-1, values.shape[-1]) == yes).T.astype(float)
    often = np.flatnonzero(members.sum(axis=1) >= _OFTEN)
    if not often.size:
        return
    rows = sparse.csr_matrix(members[often])
    places = tuple(f"{axes[-1]} {i} with {name} {float(distinct[yes]):.4g}" for i in often)
    group = Curves(f"by {name} of each {axes[-1]}", rows, places=places)
    lead = values.shape[:-1]
    whole = Quantity(
        f"{name} of each {axes[-1]}", tuple(axes[:-1]), np.zeros(lead), ordered=False, coded=True
    )
    turn = np.tile(np.arange(lead[1]), lead[0])
    yield from (
        (whole, found) for found in in_groups(group, *between(f"stretch of {axes[1]}", axes[1], turn))
    )
    for found in cycles(len(turn), f"{axes[0]} and {axes[1]}"):
        for row, place in zip(rows, places, strict=True):
            turns = sparse.csr_matrix(sparse.csr_matrix(found.values).multiply(row))
            yield whole, replace(found, label=f"{found.label} of {place}", values=turns)


def cells(
    axes: Sequence[str], shape: tuple[int, ...], columns: Mapping[str, np.ndarray]
) -> Iterator[Quantity]:
    """What two columns of few values tell apart together, as channels at noon, but for two along the same single axis.

    Args:
        axes: of an observed site.
        shape: of the site.
        columns: of the data, of as many axes, of size 1 along those that a column does not lie on.
    """
    made = {n: np.unique(c, return_inverse=True)[1].reshape(c.shape) for n, c in columns.items()}
    few = {name: index for name, index in made.items() if 1 <= index.max() < GROUPS}
    wide = {name: _varies(index) for name, index in few.items()}
    for one, other in _apart(itertools.combinations(few, 2), wide):
        index = joined(*np.broadcast_arrays(few[one], few[other]))
        if index is not None:
            whole = np.broadcast_to(index, shape)
            yield Quantity(f"{one} and {other}", tuple(axes), whole, ordered=False, coded=True)


def together(
    axes: Sequence[str], shape: tuple[int, ...], columns: Mapping[str, np.ndarray]
) -> Iterator[tuple[Quantity, Curves]]:
    """What two columns tell together: between two values of one in a group of the other, or near a place of both.

    As what a band does near a station. Not for two along the same single axis, which `curves` of that axis holds.

    Args:
        axes: of an observed site.
        shape: of the site.
        columns: of the data, of as many axes, of size 1 along those that a column does not lie on.
    """
    if ORDER * np.prod(shape) > _LARGEST:
        return
    wide = {name: _varies(column) for name, column in columns.items()}
    flat = {name: np.broadcast_to(column, shape).reshape(-1) for name, column in columns.items()}
    made = {name: np.unique(column, return_inverse=True)[1] for name, column in flat.items()}
    few = [name for name, index in made.items() if 1 <= index.max() < GROUPS]
    real = [n for n, index in made.items() if columns[n].dtype.kind == "f" and index.max() >= SMOOTH_FROM]

    def whole(one: str, other: str) -> Quantity:
        values = made[one].reshape(shape)
        return Quantity(f"{one} and {other}", tuple(axes), values, ordered=False, coded=True)

    for one, other in _apart(itertools.product(few, real), wide):
        group = by_group(one, made[one], flat[one])
        yield from ((whole(one, other), found) for found in along_in_groups(group, other, flat[other]))
    for one, other in _apart(itertools.combinations(real, 2), wide):
        place = np.stack([flat[one], flat[other]], axis=1)
        yield from ((whole(one, other), found) for found in over_both((one, other), place))


def _apart(pairs: Iterable[tuple[str, str]], wide: Mapping[str, tuple[int, ...]]) -> list[tuple[str, str]]:
    """The first pairs of columns that do not both vary along the same single axis, from the axes of each."""
    return [(a, b) for a, b in pairs if a != b and (wide[a] != wide[b] or len(wide[a]) > 1)][:MOST_PAIRS]


def _varies(values: np.ndarray) -> tuple[int, ...]:
    """Axes along which an array varies."""
    return tuple(i for i, n in enumerate(values.shape) if n > 1 and (values != values.take([0], i)).any())
