"""Ways for a perturbation to vary along an axis: smoothly, as a ripple, with a column of the data, by groups."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, cast

import numpy as np
from scipy import sparse, stats

from dtprob.effects.covering import covering
from dtprob.gap.model.problem import Problem
from dtprob.gap.where.data_columns import columns
from dtprob.gap.where.windows import windows, windows_of_values, within

SMOOTH_FROM: Final = 6
"""Positions, or values, along which something may vary smoothly."""
ORDER: Final = 4
"""Half waves of what counts as smooth."""
_FINEST: Final = 512
"""Half waves of the finest ripple that is looked for."""
_FEW: Final = 8
_COARSE: Final = 32
"""Columns up to which ripples are as fine as that, and half waves of the finest ones over more columns."""
_CROSSED: Final = 3
"""Half waves along each of two columns of what varies over both."""
_SHARES: Final = 16
"""Parts of a column between whose values steps are looked for."""
_CENTRES: Final = 64
_NEAREST: Final = (1 / 32, 1 / 16, 1 / 8, 1 / 4)
"""Places in the plane of two columns about which a compact region is looked for, and shares of the positions in one."""
MOST_PAIRS: Final = 6
_MOST_PLANES: Final = 66
"""Pairs of columns that are looked at, and those of which no more than what is smooth over both is."""
GROUPS: Final = 32
_MOST_WINDOWS: Final = 1 << 13
"""Windows in groups that are looked at."""
_SHARED: Final = 8
"""Values of a real column up to which it is looked at by value too, and positions that share one of them on average."""
_CELL: Final = 4
"""Positions in each cell of two columns, on average, from which cells may be off by an amount of their own."""
_LONGEST: Final = 24
"""Period of the longest cycle that is looked for; longer ones show as ripples."""
_TURNS: Final = 24
"""Times that a cycle has to come round: sums of a few entries are far from normal."""
OWN_TURNS: Final = 6
"""The same of a cycle of each cluster's own, of which it is what many of them tell together."""


class Ripple(NamedTuple):
    """What a band of ripples is along.

    Attributes:
        over: an axis or a column.
        lowest: half waves of the first curve; each of the next has one more.
    """

    over: str
    lowest: int


@dataclass(frozen=True)
class Curves:
    """Ways to vary along an axis, each with a weight of its own.

    Attributes:
        label: how, in words.
        values: (weight, position).
        ripple: of a band of ripples, what they are along.
        column: of groups of positions, the column of the data that makes them.
        plain: whether they follow a column, which the user knows by name, and not positions alone.
        overlaps: whether they tell the same many times over: their largest score says where, but their sum says nothing.
        places: where each of them lies, in words, of those that lie somewhere.
    """

    label: str
    values: np.ndarray | sparse.csr_matrix
    ripple: Ripple | None = None
    column: str | None = None
    plain: bool = False
    overlaps: bool = False
    places: tuple[str, ...] = ()

    @property
    def extent(self) -> tuple[int, int]:
        """How many weights there are, and along how many positions they run."""
        weights, size = cast("tuple[int, int]", self.values.shape)
        return weights, size

    def band(self, first: int, stop: int) -> Curves:
        """The curves of a ripple from one to another, that one left out.

        Raises:
            ValueError: these are no ripples.
        """
        if self.ripple is None:
            raise ValueError(f"{self.label} is no ripple, and has no bands")
        return _ripple(self.ripple.over, self.ripple.lowest + first, np.asarray(self.values[first:stop]))


def curves(problem: Problem, axis: str, size: int) -> tuple[Curves, ...]:
    """All curves along an axis of some positions, each label once; none where the axis is short."""
    if size < SMOOTH_FROM:
        return ()
    # ripples over a column of the axis's name are those over its positions, at their true places
    return tuple({found.label: found for found in _curves(problem, axis, size)}.values())


def _curves(problem: Problem, axis: str, size: int) -> Iterator[Curves]:
    place = (np.arange(size) + 0.5) / size
    yield Curves(f"smooth in {axis}", _waves(place, 1, ORDER))
    yield from _ripples(axis, place, _FINEST)
    found = columns(problem, axis, size)
    made = {n: np.unique(c, return_inverse=True)[1] for n, c in found.items() if _makes_groups(c)}
    by = {n: by_group(n, index, found[n]) for n, index in made.items()}
    for name, column in found.items():
        if _is_ordered(column):
            yield from over_column(name, column, _FINEST if len(found) <= _FEW else _COARSE)
        if name in by:
            yield by[name]
    yield from _pairs(found, by)
    yield from itertools.islice(_cells(found, made), MOST_PAIRS)
    for group in itertools.islice(by.values(), 0 if axis in found else MOST_PAIRS):
        yield from _in_groups(group, *_between(f"stretch of {axis}", axis, np.arange(size)))


def by_group(name: str, index: np.ndarray, column: np.ndarray) -> Curves:
    """By the groups (size,) that a column makes of positions."""
    places = groups_in_words(index, {name: column})
    return Curves(f"by {name}", grouped(index), column=name, plain=True, places=places)


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


def _pairs(found: Mapping[str, np.ndarray], by: Mapping[str, Curves]) -> Iterator[Curves]:
    """What varies with two columns (size,) together: smooth over both, along one in each group of the other.

    Args:
        found: the columns.
        by: groups of those that make some.
    """
    smooth = [n for n, c in found.items() if _is_ordered(c) and np.issubdtype(c.dtype, np.floating)]
    for i, (one, other) in enumerate(list(itertools.combinations(smooth, 2))[:_MOST_PLANES]):
        place = np.stack([found[one], found[other]], axis=1)
        yield from over_both((one, other), place) if i < MOST_PAIRS else [_over_plane((one, other), place)]
    for along in (smooth, [n for n, c in found.items() if _is_rising(c)]):
        crossed = [(one, other) for one, other in itertools.product(along, by) if one != other]
        for one, other in crossed[:MOST_PAIRS]:
            yield from along_in_groups(by[other], one, found[one])


def over_both(names: tuple[str, str], place: np.ndarray) -> Iterator[Curves]:
    """What varies over the plane of two columns (size, 2): smoothly, and near a place."""
    yield _over_plane(names, place)
    yield _neighbourhoods(names, place.astype(float))


def _over_plane(names: tuple[str, str], place: np.ndarray) -> Curves:
    """Products of smooth curves along each of two columns (size, 2)."""
    first, second = (_waves(_rank(column), 1, _CROSSED) for column in place.T)
    products = first[:, None] * second[None]
    return Curves(f"over {names[0]} and {names[1]}", products.reshape(-1, len(place)))


def along_in_groups(group: Curves, name: str, column: np.ndarray) -> Iterator[Curves]:
    """What varies with a column (size,) in each group: along it, and between two of its values."""
    lines = sparse.csr_matrix(group.values).multiply(_line(column)).tocsr()
    yield replace(group, label=f"along {name} {group.label}", column=None, values=lines)
    yield from _in_groups(group, *_between(f"between two values of {name}", name, column))


def _in_groups(group: Curves, *some: Curves) -> Iterator[Curves]:
    """Windows along an axis in each group of its positions; not where there would be very many."""
    for found in some:
        if group.extent[0] * found.extent[0] <= _MOST_WINDOWS:
            values = within(sparse.csr_matrix(group.values), sparse.csr_matrix(found.values))
            several = np.flatnonzero(np.diff(values.indptr) > 1)
            words = [f"{one}, {other}" for one, other in itertools.product(group.places, found.places)]
            places = tuple(words[i] for i in several)
            yield Curves(f"{found.label} {group.label}", values[several], overlaps=True, places=places)


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


def _cells(found: Mapping[str, np.ndarray], made: Mapping[str, np.ndarray]) -> Iterator[Curves]:
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


def grouped(index: np.ndarray) -> sparse.csr_matrix:
    """A weight for each group, from the groups of positions (size,)."""
    return sparse.csr_matrix((np.ones(len(index)), (index, np.arange(len(index)))))


def groups_in_words(index: np.ndarray, columns: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """Each group of positions (size,) by the values that columns (size,) have in it: `band 2 and day 11`."""
    _, first = np.unique(index, return_index=True)
    return tuple(" and ".join(f"{n} {float(column[i]):.6g}" for n, column in columns.items()) for i in first)


def cycles(size: int, over: str, *, turns: int = _TURNS) -> tuple[Curves, ...]:
    """For each period, the phases at which something may repeat along axes of some positions; none where they are short."""
    place = np.arange(size)
    return tuple(
        Curves(f"every {period} along {over}", sparse.csr_matrix((np.ones(size), (place % period, place))))
        for period in range(2, min(_LONGEST, size // turns) + 1)
    )


def stretches(size: int, over: str) -> tuple[Curves, ...]:
    """Half-overlapping stretches of an axis of some positions, 2, 4, 8 ... long, each with a weight; none of short axes."""
    if size < SMOOTH_FROM:
        return ()
    values, ends = windows(size)
    places = tuple(f"{over} {low} to {stop - 1}" for low, stop in ends)
    return (Curves(f"stretch of {over}", values, places=places),)


def over_column(name: str, column: np.ndarray, finest: int) -> Iterator[Curves]:
    """Smooth over a column (size,), beyond values that part its ranks into equal shares, and ripples over them."""
    yield Curves(f"along {name}", _smooth(column), plain=True)
    cuts = np.unique(np.quantile(column, np.arange(1, _SHARES) / _SHARES))
    steps = np.where(column > cuts[:, None], 0.5, -0.5)
    places = tuple(f"beyond {cut:.4g} of {name}" for cut in cuts)
    yield Curves(f"beyond a value of {name}", steps, overlaps=True, places=places)
    yield from _between(f"between two values of {name}", name, column)
    finest = min(
        finest, len(np.unique(column)) - 1
    )  # finer ones are the same again at the values that there are
    yield from _ripples(name, (column - column.min()) / np.ptp(column), finest)


def _between(label: str, name: str, column: np.ndarray) -> Iterator[Curves]:
    """Between two values of a column (size,), as in the shadow of something; not where it takes few."""
    values, ends = windows_of_values(column, SMOOTH_FROM)
    if ends:
        places = tuple(f"{name} {low:.4g} to {high:.4g}" for low, high in ends)
        yield Curves(label, values, overlaps=True, places=places)


def _ripples(over: str, place: np.ndarray, finest: int) -> Iterator[Curves]:
    """Octaves of ripples over places (size,) in (0, 1)."""
    low, finest = ORDER + 1, min(len(place) - 1, finest)
    while low <= finest:
        high = min(2 * (low - 1), finest)
        yield _ripple(over, low, _waves(place, low, high))
        low = high + 1


def _ripple(over: str, low: int, values: np.ndarray) -> Curves:
    """Ripples of `low` half waves and more, one after another."""
    label = f"ripple in {over}, {low} to {low + len(values) - 1} half waves"
    return Curves(label, values, ripple=Ripple(over, low))


def _waves(place: np.ndarray, low: int, high: int) -> np.ndarray:
    """Cosines of low to high half waves over places (size,) in (0, 1)."""
    return np.cos(np.pi * np.outer(np.arange(low, high + 1), place))


def _smooth(column: np.ndarray) -> np.ndarray:
    """Cosines of few half waves over the ranks (size,), and a line over the values: far ones have leverage.

    The line may cross zero anywhere, so a constant is there too: not every model has a level of its own.
    """
    line = _line(column)
    return np.concatenate([_waves(_rank(column), 1, ORDER), line[None], np.full_like(line, 0.5**0.5)[None]])


def _line(column: np.ndarray) -> np.ndarray:
    """A line over a column's values (size,), of mean 0 and of half the mean square of a constant."""
    return (column - column.mean()) / (2**0.5 * column.std())


def _rank(column: np.ndarray) -> np.ndarray:
    """Ranks (size,) in (0, 1), so that a few far values do not bend the curves."""
    return (stats.rankdata(column) - 0.5) / len(column)
