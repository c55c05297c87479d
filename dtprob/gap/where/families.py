"""Ways in which the values of a site may be wrong, made from the model's own trace and the data's columns.

A perturbation is a factor (the same for all, the value itself, its conjugate, its neighbour) times a pattern: weights that
are shared along some axes, that vary smoothly, as a ripple or in a cycle along one, with a column, or by groups.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

import jax.numpy as jnp
import numpy as np

from dtprob.gap.model.problem import Problem
from dtprob.gap.observation.likelihoods import likelihood
from dtprob.gap.where.curves import Curves
from dtprob.gap.where.ordered import COLUMNS, Along, alike_and_by_last, in_order
from dtprob.gap.where.quantities import Quantity
from dtprob.models.axes import is_unnamed

_BAND: Final = 6
"""Entries of an axis from which it may be a band, whose mirror frequency an imbalance of I and Q brings in."""
_MOST_BY_COLUMN: Final = 1 << 10
"""Curves along an axis up to which each entry of a last axis has its own."""
type Over = Sequence[tuple[Quantity, Sequence[Curves]]]


@final
class Summed:
    """Scores (n, *kept, part) of the entries of a site, the axes that are not kept summed over."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values
        self._along: dict[int, np.ndarray] = {}

    def along(self, size: int) -> np.ndarray:
        """The first kept axes together, of so many positions, before all else (size, n * rest); made once."""
        if size not in self._along:
            moved = np.moveaxis(self.values.reshape(len(self.values), size, -1), 1, 0)
            self._along[size] = np.ascontiguousarray(moved).reshape(size, -1)
        return self._along[size]


@dataclass(frozen=True)
class Pattern:
    """Weights that stand for a perturbation of a whole site.

    Attributes:
        label: how it varies, in words.
        kept: axes of the site along which it varies.
        curves: along the first kept axes together, each position of the others having weights of its own; None for a
            weight of its own at every position.
    """

    label: str
    kept: tuple[int, ...]
    curves: Curves | None = None

    def scores(self, summed: Summed) -> np.ndarray:
        """Scores (n, weights) of the weights from those of the entries, other axes summed over."""
        n = len(summed.values)
        if self.curves is None:
            return summed.values.reshape(n, -1)
        mixed = self.curves.values @ summed.along(self.curves.extent[1])
        return np.moveaxis(mixed.reshape(mixed.shape[0], n, -1), 0, 1).reshape(n, -1)

    def perturbation(self, weights: np.ndarray, shape: Sequence[int], parts: int) -> np.ndarray:
        """The entries (*site, part) that weights stand for; broadcasts to the site's shape."""
        along = weights
        if self.curves is not None:
            along = self.curves.values.T @ weights.reshape(self.curves.extent[0], -1)
        return along.reshape(*(n if i in self.kept else 1 for i, n in enumerate(shape)), parts)


@dataclass(frozen=True)
class Family:
    """A pattern times a factor.

    Attributes:
        kind: what is added: "additive", "relative", "conjugate", "from the next <axis>", "location", "spread" or "shape".
        pattern: how its weights vary.
        factor: by which the weights are multiplied, broadcasting to the site.
    """

    kind: str
    pattern: Pattern
    factor: np.ndarray

    @property
    def label(self) -> str:
        """In words."""
        return f"{self.kind}, {self.pattern.label}"

    @property
    def is_simple(self) -> bool:
        """Whether it is what most causes do: along axes, smooth along one axis or column, or by the groups of one."""
        return self.pattern.curves is None or self.pattern.curves.simple

    def step(self, scores: np.ndarray, variance: np.ndarray, value: np.ndarray) -> np.ndarray:
        """The perturbation of the site that scores (entry,) point to, of the site's shape and dtype."""
        floor = 1e-12 * max(float(variance.max(initial=0.0)), 1e-300)
        weights = np.where(variance > floor, scores / np.where(variance > floor, variance, 1.0), 0.0)
        parts = self.pattern.perturbation(weights, value.shape, 2 if np.iscomplexobj(value) else 1)
        step = parts[..., 0] - 1j * parts[..., 1] if np.iscomplexobj(value) else parts[..., 0]
        return np.broadcast_to(step * self.factor, value.shape)


@dataclass(frozen=True)
class Site:
    """A site's values at a fit, and the gradients (n, *site) of data and replicates there.

    Attributes:
        name: the site.
        axes: its axes.
        value: at the fit, of the gradients' shape.
        gradients: of the data and of replicates.
        kinds: factor of each kind of perturbation.
        rows: of an observation, its whitened components that move; None for a deterministic site.
    """

    name: str
    axes: tuple[str, ...]
    value: np.ndarray
    gradients: np.ndarray
    kinds: Mapping[str, np.ndarray]
    rows: tuple[int, ...] | None = None


def deterministic(name: str, axes: tuple[str, ...], value: np.ndarray, gradients: np.ndarray) -> Site:
    """A deterministic site of the model; `value` may be smaller than the gradients along axes of size 1."""
    grown = np.broadcast_to(value, gradients.shape[1:])
    kinds = {"additive": np.ones(()), "relative": grown}
    if np.iscomplexobj(grown):
        kinds["conjugate"] = np.conj(grown)
        for i, axis in enumerate(axes):
            if grown.shape[i] > 1:
                kinds[f"from the next {axis}"] = np.roll(grown, -1, i)
                kinds[f"from the last {axis}"] = np.roll(grown, 1, i)
            if grown.shape[i] >= _BAND and (i or grown.ndim == 1):  # axis 0 is the clusters'
                kinds[f"image along {axis}"] = np.conj(np.flip(grown, i))
    return Site(name, axes, grown, gradients, kinds)


def observed(problem: Problem, rows: np.ndarray, unnamed: Collection[str]) -> Iterator[Site]:
    """Spreads of what is observed, and locations where no site stands for them.

    What rows of a mixture tell beside (where its parts lie, how often each comes) is its shape.

    Args:
        problem: the model on its data.
        rows: projected ones (n, cluster, row).
        unnamed: the observations whose locations are looked at; see `dtprob.gap.model.inline`.
    """
    for name, own in problem.rows.by_site(rows).items():
        site, count = problem.declaration.observed[name], own.shape[1]
        located = problem.located[name]
        complex_parts = 2 if likelihood(problem.families[name]).is_complex else 1
        kinds = [("location", range(complex_parts))] if name in unnamed else []
        kinds += [("spread", range(located, located + 1))] if located < count else []
        kinds += [("shape", range(row, row + 1)) for row in range(located + 1, count)]
        for kind, moved in kinds:
            part = own[:, moved[0]] if len(moved) == 1 else own[:, moved[0]] - 1j * own[:, moved[1]]
            value = np.ones(site.shape, part.dtype)
            yield Site(name, site.axes, value, part, {kind: np.ones(())}, tuple(moved))


def shifted(problem: Problem, x: np.ndarray, site: Site, steps: np.ndarray) -> np.ndarray:
    """Whitened shifts (n, cluster, row) of perturbations (n, *site), to first order."""
    if site.rows is None:
        return np.moveaxis(np.asarray(problem.compiled.site_shift(x, {site.name: steps})), -1, 0)
    parts = (np.real(steps), np.imag(steps))
    found = []
    for i in range(len(steps)):
        rows = {
            n: np.zeros((count, *problem.declaration.sites[n].shape))
            for n, count in problem.rows.components.items()
        }
        for place, part in zip(site.rows, parts, strict=False):
            rows[site.name][place] = part[i]
        found.append(np.asarray(problem.rows.stack({n: jnp.asarray(v) for n, v in rows.items()})))
    return np.stack(found)


def families(along: Along, over: Over, site: Site) -> Iterator[tuple[Family, np.ndarray]]:
    """Every family of a site with its scores (1 + replicate, entry), one after another.

    Args:
        along: the curves along an axis of a size.
        over: quantities with the curves over them.
        site: what is perturbed.
    """
    patterns = list({(p.label, p.kept): p for p in _patterns(along, over, site)}.values())
    for kind, factor in site.kinds.items():
        sums = _summed(site.gradients * factor, {pattern.kept for pattern in patterns})
        summed = {kept: Summed(_parts(values)) for kept, values in sums.items()}
        for pattern in patterns:
            yield Family(kind, pattern, factor), pattern.scores(summed[pattern.kept])


def _summed(entries: np.ndarray, wanted: Collection[tuple[int, ...]]) -> dict[tuple[int, ...], np.ndarray]:
    """Entries (n, *site) summed over the axes that are not kept, each sum taken from the smallest that holds it."""
    summed = {tuple(range(entries.ndim - 1)): entries}
    for kept in sorted(wanted, key=lambda kept: -len(kept)):
        around = min((k for k in summed if set(kept) <= set(k)), key=lambda k: summed[k].size)
        summed[kept] = np.einsum(summed[around], [entries.ndim, *around], [entries.ndim, *kept])
    return summed


def _parts(values: np.ndarray) -> np.ndarray:
    """Real and imaginary part along a new last axis, of size 1 for what is real."""
    parts, kind = (2, complex) if np.iscomplexobj(values) else (1, float)
    return np.ascontiguousarray(values, kind).view(float).reshape(*values.shape, parts)


def _patterns(along: Along, over: Over, site: Site) -> Iterator[Pattern]:
    """Pooled along axes, and along curves on one axis or over a quantity."""
    for kept in _kept_axes(site.value.shape):
        yield Pattern(" x ".join(site.axes[i] for i in kept) or "common", kept)
    for i, axis in enumerate(site.axes):
        for one in along(axis, site.value.shape[i]):
            of_one = alike_and_by_last(one, i, site.axes, site.value.shape, _MOST_BY_COLUMN)
            yield from (Pattern(found.label, kept, found) for kept, found in of_one)
    for quantity, all_curves in over:
        if (kept := quantity.kept(site.axes, site.value.shape)) is not None:
            yield from (Pattern(found.label, kept, found) for found in all_curves)
            rest = tuple(range(len(kept), site.value.ndim))
            classes = all(is_unnamed(site.axes[i]) for i in rest) and _size(site, rest) <= COLUMNS
            if rest and (classes or not quantity.ordered) and kept == tuple(range(len(kept))):
                each = " x ".join(site.axes[i] for i in rest)
                yield from (Pattern(f"{found.label} x {each}", kept + rest, found) for found in all_curves)
    yield from (
        Pattern(found.label, kept, found) for kept, found in in_order(along, site.axes, site.value.shape)
    )


def _size(site: Site, axes: Sequence[int]) -> int:
    """Positions along some axes."""
    return int(np.prod([site.value.shape[i] for i in axes], dtype=int))


def _kept_axes(shape: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Axes along which a perturbation varies: none, one, all but one, all."""
    wide = [i for i, n in enumerate(shape) if n > 1]
    sizes = sorted({0, 1, len(wide) - 1, len(wide)} & set(range(len(wide) + 1)))
    for size in sizes:
        yield from itertools.combinations(wide, size)
