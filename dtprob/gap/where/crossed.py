"""Ways for a perturbation to vary with two columns of the data together: over their plane, in each group, by cells."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy import sparse

from dtprob.effects.covering import covering
from dtprob.gap.where.curves import Curves, between, grouped, groups_in_words, line, rank, waves
from dtprob.gap.where.windows import within

_CROSSED: Final = 3
"""Half waves along each of two columns of what varies over both."""
_CENTRES: Final = 64
_NEAREST: Final = (1 / 32, 1 / 16, 1 / 8, 1 / 4)
"""Places in the plane of two columns about which a compact region is looked for, and shares of the positions in one."""
MOST_PAIRS: Final = 6
"""Pairs of columns of each kind that are looked at."""
_MOST_WINDOWS: Final = 1 << 13
"""Windows in groups that are looked at."""
_CELL: Final = 4
"""Positions in each cell of two columns, on average, from which cells may be off by an amount of their own."""


def over_both(names: tuple[str, str], place: np.ndarray) -> Iterator[Curves]:
    """What varies over the plane of two columns (size, 2): smoothly, and near a place."""
    yield over_plane(names, place)
    yield _neighbourhoods(names, place.astype(float))


def over_plane(names: tuple[str, str], place: np.ndarray) -> Curves:
    """Products of smooth curves along each of two columns (size, 2)."""
    first, second = (waves(rank(column), 1, _CROSSED) for column in place.T)
    products = first[:, None] * second[None]
    return Curves(f"over {names[0]} and {names[1]}", products.reshape(-1, len(place)), says_where=True)


def _neighbourhoods(over: tuple[str, str], place: np.ndarray) -> Curves:
    """The positions nearest to each of a few places (size, 2) that cover them evenly, in groups of several sizes."""
    unit = (place - place.mean(axis=0)) / place.std(axis=0)
    size, centres = len(unit), covering(unit, _CENTRES)
    nearest = np.argsort(np.linalg.norm(unit - unit[centres, None], axis=-1), axis=1)
    members = sorted({max(int(size * share), 2) for share in _NEAREST})
    groups = [row[:count] for count in members for row in nearest]
    weight = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    shape = (len(groups), size)
    values = sparse.csr_matrix((np.ones(len(weight)), (weight, np.concatenate(groups))), shape)
    about = [" and ".join(f"{n} {at:.4g}" for n, at in zip(over, place[i], strict=True)) for i in centres]
    places = tuple(f"the {count} of {size} nearest to {at}" for count in members for at in about)
    return Curves(f"near a place of {over[0]} and {over[1]}", values, overlaps=True, places=places)


def products(columns: Mapping[str, np.ndarray], pairs: Sequence[tuple[str, str]]) -> Iterator[Curves]:
    """The product of two columns (size,) of each pair, as one feature of a regression acts through another."""
    if pairs:
        places = tuple(f"{one} times {other}" for one, other in pairs)
        values = np.stack([line(columns[one]) * line(columns[other]) for one, other in pairs])
        yield Curves("product of two columns", values, overlaps=True, places=places)


def along_in_groups(group: Curves, name: str, column: np.ndarray) -> Iterator[Curves]:
    """What varies with a column (size,) in each group: along it, and between two of its values."""
    lines = sparse.csr_matrix(group.values).multiply(line(column)).tocsr()
    yield replace(group, label=f"along {name} {group.label}", column=None, values=lines, says_where=True)
    yield from in_groups(group, *between(f"between two values of {name}", name, column))


def in_groups(group: Curves, *some: Curves) -> Iterator[Curves]:
    """Windows along an axis in each group of its positions; not where there would be very many."""
    for found in some:
        if group.extent[0] * found.extent[0] <= _MOST_WINDOWS:
            values = within(sparse.csr_matrix(group.values), sparse.csr_matrix(found.values))
            several = np.flatnonzero(np.diff(values.indptr) > 1)
            words = [f"{one}, {other}" for one, other in itertools.product(group.places, found.places)]
            places = tuple(words[i] for i in several)
            yield Curves(f"{found.label} {group.label}", values[several], overlaps=True, places=places)


def by_both(found: Mapping[str, np.ndarray], made: Mapping[str, np.ndarray]) -> Iterator[Curves]:
    """By the groups of two columns (size,), from the group of each position in each of them."""
    for one, other in itertools.combinations(made, 2):
        index = joined(made[one], made[other])
        if index is not None and _CELL * (index.max() + 1) <= len(index):
            places = groups_in_words(index, {one: found[one], other: found[other]})
            yield Curves(f"by {one} and {other}", grouped(index), plain=True, places=places)


def joined(one: np.ndarray, other: np.ndarray) -> np.ndarray | None:
    """The group of each position by its groups of two columns; None where those of one lie within the other's."""
    _, index = np.unique(one * (other.max() + 1) + other, return_inverse=True)
    return None if index.max() == max(one.max(), other.max()) else index.reshape(one.shape)
