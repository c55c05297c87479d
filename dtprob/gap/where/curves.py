"""Ways for a perturbation to vary: smoothly along an axis, as a ripple, with a column of the data or a site, by groups."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, cast

import equinox as eqx
import numpy as np
from scipy import sparse, stats

from dtprob.gap.model.problem import Problem
from dtprob.models.axes import is_unnamed
from dtprob.models.declaration import Site

_SMOOTH_FROM: Final = 6
_ORDER: Final = 4
"""Half waves of what counts as smooth."""
_FINEST: Final = 512
"""Half waves of the finest ripple that is looked for."""
_CROSSED: Final = 3
"""Half waves along each of two columns of what varies over both."""
_SHARES: Final = 16
"""Parts of a column between whose values steps are looked for."""
_MOST_PAIRS: Final = 6
_LONGEST: Final = 24
"""Period of the longest cycle that is looked for; longer ones show as ripples."""
_LARGEST: Final = 1 << 18
"""Numbers that the curves over one quantity may take in a band."""
_FINEST_OVER: Final = 64
"""Half waves of the finest ripple over a quantity of several axes or a site."""
_OFTEN: Final = 24
"""Times that a quantity takes each of its values, on average, where each of them may be off by an amount of its own."""
_TURNS: Final = 24
"""Times that a cycle has to come round: sums of a few entries are far from normal."""


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
        overlaps: whether they tell the same many times over: their largest score says where, but their sum says nothing.
    """

    label: str
    values: np.ndarray | sparse.csr_matrix
    ripple: Ripple | None = None
    column: str | None = None
    overlaps: bool = False

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


@dataclass(frozen=True)
class Quantity:
    """What the model computes or the data tell at positions of some axes, over which a perturbation may vary.

    Attributes:
        name: the site or the column.
        axes: along which it varies.
        values: at their positions.
        ordered: whether its values are more than names: near ones may act alike.
    """

    name: str
    axes: tuple[str, ...]
    values: np.ndarray
    ordered: bool = True

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
        flat = self.values.reshape(-1)
        if _ORDER * flat.size > _LARGEST:
            return
        distinct, index = np.unique(flat, return_inverse=True)
        if _OFTEN * len(distinct) <= flat.size:
            yield Curves(f"by value of {self.name}", _grouped(index))
        if self.ordered:
            yield from _over(self.name, flat, min(_FINEST_OVER, _LARGEST // flat.size))


def quantity(name: str, axes: Sequence[str], values: np.ndarray) -> Quantity | None:
    """A real site or column, on the axes along which it varies; None where too few of its values differ."""
    if not np.issubdtype(values.dtype, np.floating) or not np.isfinite(values).all():
        return None
    wide = [i for i, n in enumerate(values.shape) if n > 1 and (values != values.take([0], i)).any()]
    values = values[tuple(slice(None) if i in wide else 0 for i in range(values.ndim))]
    if len(np.unique(values)) < _SMOOTH_FROM:
        return None
    return Quantity(name, tuple(axes[i] for i in wide), values)


def groups(name: str, axes: Sequence[str], values: np.ndarray) -> Iterator[Quantity]:
    """What a column of whole numbers on several axes tells apart, as what each device did last.

    Each of its values, anywhere and at each position of the last axis, and what it holds along that axis all together.
    """
    whole = np.issubdtype(values.dtype, np.integer) or values.dtype == bool
    if not whole or values.ndim < 2 or (values == values.flat[0]).all():
        return
    last, (distinct, index) = values.shape[-1], np.unique(values, return_inverse=True)
    yield Quantity(name, tuple(axes), values, ordered=_OFTEN * len(distinct) > values.size)
    each = last * index.reshape(values.shape) + np.arange(last)
    yield Quantity(f"{name} of each {axes[-1]}", tuple(axes), each, ordered=False)
    if last > 1:
        _, rows = np.unique(values.reshape(-1, last), axis=0, return_inverse=True)
        yield Quantity(f"{name} of all", tuple(axes[:-1]), rows.reshape(values.shape[:-1]), ordered=False)


def curves(problem: Problem, axis: str, size: int) -> tuple[Curves, ...]:
    """All curves along an axis of some positions, each label once; none where the axis is short."""
    if size < _SMOOTH_FROM:
        return ()
    # ripples over a column of the axis's name are those over its positions, at their true places
    return tuple({found.label: found for found in _curves(problem, axis, size)}.values())


def _curves(problem: Problem, axis: str, size: int) -> Iterator[Curves]:
    place = (np.arange(size) + 0.5) / size
    yield Curves(f"smooth in {axis}", _waves(place, 1, _ORDER))
    yield from _ripples(axis, place, _FINEST)
    found = columns(problem, axis, size)
    for name, column in found.items():
        groups, index = np.unique(column, return_inverse=True)
        if np.issubdtype(column.dtype, np.floating) or 2 * len(groups) > size:
            yield from _over(name, column, _FINEST)
        else:
            yield Curves(f"by {name}", _grouped(index), column=name)
    smooth = [name for name, column in found.items() if np.issubdtype(column.dtype, np.floating)]
    for one, other in list(itertools.combinations(smooth, 2))[:_MOST_PAIRS]:
        crossed = _waves(_rank(found[one]), 1, _CROSSED), _waves(_rank(found[other]), 1, _CROSSED)
        products = crossed[0][:, None] * crossed[1][None]
        yield Curves(f"over {one} and {other}", products.reshape(-1, size))


def _grouped(index: np.ndarray) -> sparse.csr_matrix:
    """A weight for each group, from the groups of positions (size,)."""
    return sparse.csr_matrix((np.ones(len(index)), (index, np.arange(len(index)))))


def cycles(size: int, over: str) -> tuple[Curves, ...]:
    """For each period, the phases at which something may repeat along axes of some positions; none where they are short."""
    place = np.arange(size)
    return tuple(
        Curves(f"every {period} along {over}", sparse.csr_matrix((np.ones(size), (place % period, place))))
        for period in range(2, min(_LONGEST, size // _TURNS) + 1)
    )


def stretches(size: int, over: str) -> tuple[Curves, ...]:
    """Half-overlapping stretches of an axis of some positions, 2, 4, 8 ... long, each with a weight; none of short axes."""
    if size < _SMOOTH_FROM:
        return ()
    lengths = [2**k for k in range(1, int(np.log2(size)))]
    windows = [(low, low + n) for n in lengths for low in range(0, size - n + 1, n // 2)]
    weight = np.repeat(np.arange(len(windows)), [stop - low for low, stop in windows])
    position = np.concatenate([np.arange(*window) for window in windows])
    shape = (len(windows), size)
    return (
        Curves(f"stretch of {over}", sparse.csr_matrix((np.ones(len(weight)), (weight, position)), shape)),
    )


def _over(name: str, column: np.ndarray, finest: int) -> Iterator[Curves]:
    """Smooth over a column (size,), beyond one of its values, and ripples over them."""
    yield Curves(f"along {name}", _smooth(column))
    yield Curves(f"beyond a value of {name}", _steps(column), overlaps=True)
    yield from _ripples(name, (column - column.min()) / np.ptp(column), finest)


def _ripples(over: str, place: np.ndarray, finest: int) -> Iterator[Curves]:
    """Octaves of ripples over places (size,) in (0, 1)."""
    low, finest = _ORDER + 1, min(len(place) - 1, finest)
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
    line = (column - column.mean()) / (2**0.5 * column.std())
    return np.concatenate([_waves(_rank(column), 1, _ORDER), line[None], np.full_like(line, 0.5**0.5)[None]])


def _steps(column: np.ndarray) -> np.ndarray:
    """Steps at values that part the ranks into equal shares (step, size)."""
    cuts = np.unique(np.quantile(column, np.arange(1, _SHARES) / _SHARES))
    return np.where(column > cuts[:, None], 0.5, -0.5)


def _rank(column: np.ndarray) -> np.ndarray:
    """Ranks (size,) in (0, 1), so that a few far values do not bend the curves."""
    return (stats.rankdata(column) - 0.5) / len(column)


def columns(problem: Problem, axis: str, size: int) -> dict[str, np.ndarray]:
    """Columns of the data (size,) that lie along an axis of the observations and vary; of positions each coordinate."""
    if not any(axis in site.axes for site in problem.declaration.observed.values()):
        return {}
    found: dict[str, np.ndarray] = {}
    for name, column in _given(problem):
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


def whole_columns(problem: Problem, site: Site) -> dict[str, np.ndarray]:
    """Columns of the data that have an entry for each observation of a site of several axes."""
    return {n: c for n, c in _given(problem) if c.ndim > 1 and c.shape == site.shape}


def _given(problem: Problem) -> Iterator[tuple[str, np.ndarray]]:
    """The arrays of the data, but for what tells what was observed."""
    for name, values in problem.data.items():
        if name not in problem.responses and eqx.is_array_like(values):
            yield name, np.asarray(values)
