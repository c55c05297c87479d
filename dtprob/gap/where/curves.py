"""Ways for a perturbation to vary along an axis: smoothly, as a ripple, with a column of the data, by groups."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple, cast

import numpy as np
from scipy import sparse, stats

from dtprob.gap.where.windows import windows, windows_of_values

SMOOTH_FROM: Final = 6
"""Positions, or values, along which something may vary smoothly."""
ORDER: Final = 4
"""Half waves of what counts as smooth."""
_SHARES: Final = 16
"""Parts of a column between whose values steps are looked for."""
GROUPS: Final = 32
"""Values of a column up to which it may make groups, whatever they are."""
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
        says_where: whether the label says where or along what, which helps whoever looks for a cause.
        plain: whether they follow a column, which the user knows by name, and not positions alone.
        simple: whether they are what most causes do: smooth along one axis or column, or by the groups of one.
        overlaps: whether they tell the same many times over: their largest score says where, but their sum says nothing.
        of_data: whether they run over columns of the data, which the user knows by name.
        places: where each of them lies, in words, of those that lie somewhere.
    """

    label: str
    values: np.ndarray | sparse.csr_matrix
    ripple: Ripple | None = None
    column: str | None = None
    says_where: bool = False
    plain: bool = False
    simple: bool = False
    overlaps: bool = False
    of_data: bool = False
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


def by_group(name: str, index: np.ndarray, column: np.ndarray) -> Curves:
    """By the groups (size,) that a column makes of positions."""
    places = groups_in_words(index, {name: column})
    return Curves(f"by {name}", grouped(index), column=name, plain=True, simple=True, places=places)


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
    made = (
        (period, sparse.csr_matrix((np.ones(size), (place % period, place))))
        for period in range(2, min(_LONGEST, size // turns) + 1)
    )
    return tuple(Curves(f"every {period} along {over}", v, says_where=True) for period, v in made)


def stretches(size: int, over: str) -> tuple[Curves, ...]:
    """Half-overlapping stretches of an axis of some positions, 2, 4, 8 ... long, each with a weight; none of short axes."""
    if size < SMOOTH_FROM:
        return ()
    values, ends = windows(size)
    places = tuple(f"{over} {low} to {stop - 1}" for low, stop in ends)
    return (Curves(f"stretch of {over}", values, places=places),)


def over_column(name: str, column: np.ndarray, finest: int) -> Iterator[Curves]:
    """Smooth over a column (size,), steps and bends at values that part its ranks into equal shares, and ripples."""
    yield Curves(f"along {name}", _smooth(column), says_where=True, plain=True, simple=True)
    cuts = np.unique(np.quantile(column, np.arange(1, _SHARES) / _SHARES))
    steps = np.where(column > cuts[:, None], 0.5, -0.5)
    places = tuple(f"beyond {cut:.4g} of {name}" for cut in cuts)
    yield Curves(f"beyond a value of {name}", steps, overlaps=True, places=places)
    yield from _bends(name, column, cuts[cuts > column.min()])
    yield from between(f"between two values of {name}", name, column)
    finest = min(
        finest, len(np.unique(column)) - 1
    )  # finer ones are the same again at the values that there are
    yield from ripples(name, (column - column.min()) / np.ptp(column), finest)


def _bends(name: str, column: np.ndarray, cuts: np.ndarray) -> Iterator[Curves]:
    """Zero up to a value of a column (size,) and rising from there, as of what saturates, or of a breakpoint distance."""
    beyond = np.maximum(column - cuts[:, None], 0.0)
    rising = np.ptp(beyond, axis=1) > 0
    if rising.any():
        values = np.stack([line(one) for one in beyond[rising]])
        places = tuple(f"bend at {cut:.4g} of {name}" for cut in cuts[rising])
        yield Curves(f"bend at a value of {name}", values, overlaps=True, places=places)


def between(label: str, name: str, column: np.ndarray) -> Iterator[Curves]:
    """Between two values of a column (size,), as in the shadow of something; not where it takes few."""
    values, ends = windows_of_values(column, SMOOTH_FROM)
    if ends:
        places = tuple(f"{name} {low:.4g} to {high:.4g}" for low, high in ends)
        yield Curves(label, values, overlaps=True, places=places)


def ripples(over: str, place: np.ndarray, finest: int) -> Iterator[Curves]:
    """Octaves of ripples over places (size,) in (0, 1)."""
    low, finest = ORDER + 1, min(len(place) - 1, finest)
    while low <= finest:
        high = min(2 * (low - 1), finest)
        yield _ripple(over, low, waves(place, low, high))
        low = high + 1


def _ripple(over: str, low: int, values: np.ndarray) -> Curves:
    """Ripples of `low` half waves and more, one after another."""
    label = f"ripple in {over}, {low} to {low + len(values) - 1} half waves"
    return Curves(label, values, ripple=Ripple(over, low))


def waves(place: np.ndarray, low: int, high: int) -> np.ndarray:
    """Cosines of low to high half waves over places (size,) in (0, 1)."""
    return np.cos(np.pi * np.outer(np.arange(low, high + 1), place))


def _smooth(column: np.ndarray) -> np.ndarray:
    """Cosines of few half waves over the ranks (size,), and a line over the values: far ones have leverage.

    The line may cross zero anywhere, so a constant is there too: not every model has a level of its own.
    """
    straight = line(column)
    return np.concatenate(
        [waves(rank(column), 1, ORDER), straight[None], np.full_like(straight, 0.5**0.5)[None]]
    )


def line(column: np.ndarray) -> np.ndarray:
    """A line over a column's values (size,), of mean 0 and of half the mean square of a constant."""
    return (column - column.mean()) / (2**0.5 * column.std())


def rank(column: np.ndarray) -> np.ndarray:
    """Ranks (size,) in (0, 1), so that a few far values do not bend the curves."""
    return (stats.rankdata(column) - 0.5) / len(column)
