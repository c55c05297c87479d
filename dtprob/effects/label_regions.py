"""Regions of the features of labels, and slopes along these: where a predictor may be off."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Float

from dtprob.effects.common import Data
from dtprob.effects.effect import Parameter

_FEATURES: Final = 16
"""Features, the first ones, whose regions are looked at."""
_EDGE: Final = 0.05
"""Standard deviation of where a region's edge lies, as a share of the samples."""
_SOFT: Final = 1.0
"""Samples, or different values, over which a region's edge is soft, so that its place has a derivative."""
_SMOOTH: Final = 64
"""Samples that one value of a feature is shared by at most once in so many, where a region's edge may move."""
_NAMED: Final = 12
"""Values that a feature takes at most where each of them, such as a storey, is a region."""
_SHARED: Final = 8
"""Samples that share one of these values, on average."""
_GROUPED: Final = 4
"""Values from which on several of them together are regions too."""
_GROUPS: Final = 32
"""Values up to which each may have an amount of its own."""
_DIGITS: Final = 6
_ALL_DIGITS: Final = 17
"""Digits, at least, that tell any two numbers apart."""

type Weight = Callable[[Any, Mapping[str, Any]], Float[Array, " sample"]]


@dataclass(frozen=True)
class Region:
    """A region of the features.

    Attributes:
        name: its instance.
        text: what the page says of it.
        weight: at features.
        inside: which samples (sample,) lie in it.
        parameters: its own.
    """

    name: str
    text: str
    weight: Weight
    inside: np.ndarray
    parameters: tuple[Parameter, ...] = ()


def _columns(data: Data) -> Iterator[tuple[int, np.ndarray]]:
    """The features that vary, by number."""
    for index, column in enumerate(np.asarray(data["x"], float).T[:_FEATURES]):
        if np.ptp(column) > 0:
            yield index, column


def regions(data: Data) -> list[Region]:
    """The lowest, middle and highest third of each feature; of one of few values each of these, the largest first.

    Whoever drew a region did not know the samples' thirds: where a feature takes many values the edges are parameters.
    """
    found: list[Region] = []
    for index, column in _columns(data):
        values = np.unique(column)
        if len(values) <= min(_NAMED, len(column) // _SHARED):
            named = zip(_written(values), values, strict=True)
            found += [_at_value(index, column, text, float(value)) for text, value in reversed([*named])]
        if len(values) >= _GROUPED:
            found += _thirds(index, column, found)
    return found


def _written(values: np.ndarray) -> list[str]:
    """Different numbers in as few digits as keep them apart."""
    for digits in range(_DIGITS, _ALL_DIGITS):
        written = [f"{value:.{digits}g}" for value in values]
        if len(set(written)) == len(values):
            return written
    return [repr(float(value)) for value in values]


def _at_value(index: int, column: np.ndarray, written: str, value: float) -> Region:
    """Where a feature has one of its values."""

    def at(x: Any, _: Mapping[str, Any]) -> Float[Array, " sample"]:
        return (x[:, index] == value).astype(float)

    return Region(f"x{index}_is_{written}", f"where feature {index} is {written}", at, column == value)


def _thirds(index: int, column: np.ndarray, known: Sequence[Region]) -> Iterator[Region]:
    """The lowest, middle and highest third of a feature, as far as they are none of the known regions.

    Where more than a third of the samples have one value, as of a meter at its end, what lies below and above it.
    """
    low, high = (float(edge) for edge in np.quantile(column, (1 / 3, 2 / 3)))
    if low == high:
        low = float(max(column[column < high], default=-np.inf))
    places: dict[str, tuple[float, float]] = {
        "low": (-np.inf, low),
        "middle": (low, high),
        "high": (high, np.inf),
    }
    is_smooth = np.unique(column, return_counts=True)[1].max() <= len(column) / _SMOOTH
    for name, (first, last) in places.items():
        inside = (column > first) & (column <= last)
        if inside.all() or not inside.any() or any(np.array_equal(inside, one.inside) for one in known):
            continue
        ends = f"({column[inside].min():.3g} to {column[inside].max():.3g})"
        if is_smooth:
            weight, parameters = _soft(
                index, column, bool(np.isfinite(first)), bool(np.isfinite(last)), inside
            )
        else:
            weight, parameters = _hard(index, first, last), ()
        text = f"where feature {index} is {name} {ends}"
        yield Region(f"x{index}_{name}", text, weight, inside, parameters)


def _hard(index: int, first: float, last: float) -> Weight:
    """1 inside, 0 outside."""

    def within(x: Any, _: Mapping[str, Any]) -> Float[Array, " sample"]:
        return ((x[:, index] > first) & (x[:, index] <= last)).astype(float)

    return within


def _soft(
    index: int, column: np.ndarray, is_above: bool, is_below: bool, inside: np.ndarray
) -> tuple[Weight, tuple[Parameter, ...]]:
    """1 inside, 0 outside, with edges that move and have a derivative: parameters, as quantiles of the feature."""
    values = np.unique(column)
    quantiles = (np.arange(len(values)) + 0.5) / len(values)
    width = _SOFT / len(values)
    rank = np.searchsorted(values, column[inside])
    ends = {
        "from_quantile": (is_above, rank.min() / len(values)),
        "to_quantile": (is_below, (rank.max() + 1) / len(values)),
    }
    parameters = tuple(
        Parameter(name, dist.Normal(float(place), _EDGE), float(place), is_place=True)
        for name, (is_end, place) in ends.items()
        if is_end
    )

    def weight(x: Any, p: Mapping[str, Any]) -> Float[Array, " sample"]:
        quantile, inside = jnp.interp(x[:, index], values, quantiles), jnp.ones(x.shape[0])
        if is_above:
            inside = inside * jax.nn.sigmoid((quantile - p["from_quantile"]) / width)
        if is_below:
            inside = inside * jax.nn.sigmoid((p["to_quantile"] - quantile) / width)
        return inside

    return weight, parameters


def groupings(data: Data) -> Iterator[tuple[int, np.ndarray]]:
    """Features whose values may number things, such as receivers: by number, with the values."""
    for index, column in _columns(data):
        values = np.unique(column)
        if _GROUPED <= len(values) <= min(_GROUPS, len(column) // _SHARED):
            yield index, values


def slopes(data: Data, least: int = 2) -> list[Region]:
    """Each feature of at least so many values itself, from -1 at its smallest to 1 at its largest one."""
    found: list[Region] = []
    for index, column in ((i, c) for i, c in _columns(data) if len(np.unique(c)) >= least):
        middle, half = float(column.max() + column.min()) / 2, float(np.ptp(column)) / 2

        def along(
            x: Any, _: Mapping[str, Any], index: int = index, middle: float = middle, half: float = half
        ) -> jax.Array:
            return (x[:, index] - middle) / half

        whole = np.ones(len(column), bool)
        found.append(Region(f"x{index}_slope", f"ever more along feature {index}", along, whole))
    return found
