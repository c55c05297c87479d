"""Trials of a random field's entries, as close together as they make the log posterior wave, and the best of them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import cached_property
from typing import Final, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.plausible import plausible_spread
from dtprob.gap.fitting.sweep import turned_by, turns
from dtprob.gap.model.problem import Problem
from dtprob.gap.which.directions import Surroundings

_ENTRIES: Final = 3
"""Entries that a cluster may have, at most."""
_REACH: Final = 3.0
"""Standard deviations of the largest plausible spread up to which entries are looked for."""
_ALONE: Final = 6.0
"""The same of one entry alone: what has the field's entries in common is plausible up to larger sizes."""
_LINE: Final = 385
_PER_WAVE: Final = 4
"""Trials for each peak along one entry."""
_FLAT: Final = 1.0
"""Nats below which an entry does not matter to a cluster."""
_FAR_BELOW: Final = 1e6
"""Nats below the best that count as all the same."""
_TRIALS: Final = 8192
_WORK: Final = 100_000_000
"""Combinations of entries that are tried, at most, and observations in all of these; beyond, they reach less far."""
_COSINE: Final = 1e-6
"""Share of a cosine by which terms may differ from it."""
_PEAKS: Final = 6
"""Highest peaks that are looked at more finely."""
_FINER: Final = 3
"""Times that they are, by trials half as far apart."""

type Terms = Float[np.ndarray, "trial cluster"]


class Point(NamedTuple):
    """Entries of each cluster's field, and by how much all of its own angles are turned beside them."""

    entries: Float[np.ndarray, "cluster entry"]
    turn: Float[np.ndarray, " cluster"]


class _Lines(NamedTuple):
    """Entries moved one at a time, as far as they are looked for, and what clusters add to the log posterior there."""

    points: Float[np.ndarray, "line trial entry"]
    terms: Float[np.ndarray, "line trial cluster"]


class _Grid(NamedTuple):
    """Entries to try, all combinations of some along each of them, and how far these are apart."""

    points: Float[np.ndarray, "trial entry"]
    counts: tuple[int, ...]
    spacing: Float[np.ndarray, " entry"]


def is_each(problem: Problem, effect: Effect) -> bool:
    """Whether an effect is a random field of which every cluster has a few entries of its own."""
    if effect.kind == "mean" or effect.is_looked_for or not effect.rewrites:
        return False
    size = int(np.prod(problem.field_shapes[effect.name], dtype=int))
    return problem.axis_of_clusters(effect) is not None and size <= _ENTRIES * problem.n_cluster


@final
class Trials:
    """What clusters add to the log posterior with entries of an effect's field at given values.

    Args:
        problem: the model and candidates on their data.
        around: the point that what clusters share stays at.
        effect: one of those that `is_each` tells.
    """

    def __init__(self, problem: Problem, around: Surroundings, effect: Effect) -> None:
        self.problem, self.effect = problem, effect
        self._x, self._values = around.x, around.grown()
        self._shape, self._axis = problem.field_shapes[effect.name], problem.axis_of_clusters(effect) or 0
        self.entries = int(np.prod(self._shape, dtype=int)) // problem.n_cluster
        self._turns = turns(problem)
        everywhere = [np.full(problem.n_cluster, turn) for turn in self._turns]
        self._points = [turned_by(problem, around.x, turn) for turn in everywhere]

    def __call__(self, fields: Float[np.ndarray, "trial cluster entry"]) -> tuple[Terms, Terms]:
        """Terms of the log posterior, -inf where they are not finite, and how far angles are turned for these."""
        return _best_turn(self._told(fields, self._points), self._turns)

    def unturned(self, entries: Float[np.ndarray, " entry"]) -> Float[np.ndarray, " cluster"]:
        """Terms with the same entries in all clusters and no angle turned."""
        return self._told(self._everywhere(entries[None]), [self._x])[0, 0]

    def of_effect(
        self, name: str, parameters: Float[np.ndarray, " parameter"]
    ) -> Float[np.ndarray, " cluster"]:
        """Terms with another effect, of which nothing is random, at flat parameters."""
        (_, part, shifts), *_ = self.problem.programs.trial_shifts(self._values, {name: parameters[None]})
        return self.problem.compiled.shifted(self._x, shifts, part.stop - part.start)[0]

    def _told(self, fields: np.ndarray, points: list[np.ndarray]) -> Float[np.ndarray, "point trial cluster"]:
        rest = tuple(n for i, n in enumerate(self._shape) if i != self._axis)
        given = np.moveaxis(fields.reshape(len(fields), -1, *rest), 1, 1 + self._axis)
        parts = []
        for part, shifts in self.problem.programs.field_shifts(self.effect.name, self._values, given):
            count = part.stop - part.start
            parts.append(np.stack([self.problem.compiled.shifted(x, shifts, count) for x in points]))
        return np.nan_to_num(np.concatenate(parts, axis=1), nan=-np.inf, posinf=-np.inf)

    def _everywhere(
        self, points: Float[np.ndarray, "trial entry"]
    ) -> Float[np.ndarray, "trial cluster entry"]:
        return np.repeat(points[:, None], self.problem.n_cluster, axis=1)

    @property
    def is_wavy(self) -> bool:
        """Whether any entry makes the log posterior of any cluster wave."""
        return max(self.grid.counts) > _number(1)

    @cached_property
    def lines(self) -> _Lines:
        """Each entry alone, also farther than combinations of them are looked for."""
        offsets = np.linspace(-_ALONE, _ALONE, _LINE) * plausible_spread(self.effect)
        points = np.eye(self.entries)[:, None] * offsets[:, None]
        return _Lines(points, np.stack([self(self._everywhere(line))[0] for line in points]))

    @cached_property
    def grid(self) -> _Grid:
        """Entries as close together as each alone makes the log posterior wave, the null among them."""
        counts = [_count(terms) for terms in self.lines.terms]
        spread = plausible_spread(self.effect)
        spacing = 2 * _ALONE * spread / np.maximum(np.array(counts) - 1, 1)
        counts = np.minimum(counts, 2 * np.floor(_REACH * spread / spacing + 1e-9).astype(int) + 1).tolist()
        most = min(_TRIALS, max(_WORK // (self.problem.observed.count * len(self._turns)), _LINE))
        while np.prod(counts) > most:
            counts[int(np.argmax(counts))] -= 2
        lines = [step * np.arange(-(n // 2), n // 2 + 1) for n, step in zip(counts, spacing, strict=True)]
        points = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, self.entries)
        return _Grid(points, tuple(counts), spacing)

    @cached_property
    def on_grid(self) -> Terms:
        """Terms of the log posterior at each point of the grid, the same in all clusters."""
        return self(self._everywhere(self.grid.points))[0]


def best(
    trials: Trials, null: Float[np.ndarray, " cluster"], touched: Bool[np.ndarray, " cluster"] | None = None
) -> tuple[Float[np.ndarray, " cluster"], Point]:
    """Terms where entries and angles are best, the choice among trials paid for, and what these are.

    Combinations of entries are tried as far as there is time for them, and each entry alone as far as any is plausible.

    Args:
        trials: of a field.
        null: terms without it.
        touched: clusters whose entries are the same, and whose terms are their sum; the others have none. By default each
            cluster has entries of its own.
    """
    null = _pooled(null[None], null, touched)[0]
    price = float(np.log(len(trials.grid.points) + _LINE * trials.entries))
    value, kept = null, Point(np.zeros((len(null), trials.entries)), np.zeros(len(null)))
    farther = _beyond(trials, null, touched)
    for peak in itertools.chain(_peaks(trials.grid, _pooled(trials.on_grid, null, touched)), farther):
        terms, point = _refined(trials, peak, null, touched)
        is_better = terms - price > value
        value = np.where(is_better, terms - price, value)
        kept = Point(
            np.where(is_better[:, None], point.entries, kept.entries),
            np.where(is_better, point.turn, kept.turn),
        )
    return value, kept


def _best_turn(values: Float[np.ndarray, "turn trial cluster"], turns: np.ndarray) -> tuple[Terms, Terms]:
    """The highest terms over turns all round the circle, and where they are.

    A common phase of what is received with normal noise adds a cosine, so that a few turns tell what all of them do. At
    high signal-to-noise ratios the best of the few lies far below.
    """
    highest, turn = values.max(axis=0), turns[values.argmax(axis=0)]
    if len(turns) < 3:
        return highest, turn
    finite = np.where(np.isfinite(values), values, np.nan)
    wave = 2 * np.tensordot(np.exp(1j * turns), finite, 1) / len(turns)
    mean = finite.mean(axis=0)
    told = mean + np.real(np.conj(wave) * np.exp(1j * turns)[:, None, None])
    is_cosine = np.abs(told - finite).max(axis=0) < _COSINE * (1.0 + np.abs(wave))
    return np.where(is_cosine, mean + np.abs(wave), highest), np.where(is_cosine, np.angle(wave), turn)


def _pooled(
    terms: Terms, null: Float[np.ndarray, " cluster"], touched: Bool[np.ndarray, " cluster"] | None
) -> Terms:
    """Terms of clusters of their own, or the sum of those that are touched in each of them, and of the others none."""
    if touched is None:
        return terms
    return np.where(touched, terms[:, touched].sum(axis=1, keepdims=True), null)


def _count(values: Terms) -> int:
    """How many trials there are along one entry, from the peaks of the cluster that has most of them; 1 if none matters."""
    told = values[:, np.ptp(np.maximum(values, values.max(axis=0) - _FAR_BELOW), axis=0) > _FLAT]
    if not told.size:
        return 1
    peaks = (told[1:-1] > told[:-2]) & (told[1:-1] >= told[2:])
    return _number(max(int(peaks.sum(axis=0).max()), 1))


def _number(peaks: int) -> int:
    """An odd number of trials for so many peaks, so that the null is among them."""
    return 2 * (_PER_WAVE * peaks // 2) + 1


def _peaks(grid: _Grid, values: Terms) -> Iterator[Float[np.ndarray, "cluster entry"]]:
    """Entries at each cluster's highest peak, then at its second, and so on."""
    shaped = values.reshape(*grid.counts, -1)
    around = ndimage.maximum_filter(shaped, size=(*(3 for _ in grid.counts), 1), mode="nearest")
    peaks = np.where(shaped >= around, shaped, -np.inf).reshape(values.shape)
    for chosen in np.argsort(-peaks, axis=0)[:_PEAKS]:
        yield grid.points[chosen]


def _beyond(
    trials: Trials, null: Float[np.ndarray, " cluster"], touched: Bool[np.ndarray, " cluster"] | None
) -> Iterator[Float[np.ndarray, "cluster entry"]]:
    """Where each entry alone is best, if combinations do not reach so far for every cluster: a mast of another height."""
    reach = trials.grid.points.max(axis=0)
    for points, terms in zip(*trials.lines, strict=True):
        peak = points[_pooled(terms, null, touched).argmax(axis=0)]
        if np.any(np.abs(peak) > reach):
            yield peak


def _refined(
    trials: Trials,
    entries: Float[np.ndarray, "cluster entry"],
    null: Float[np.ndarray, " cluster"],
    touched: Bool[np.ndarray, " cluster"] | None,
) -> tuple[Float[np.ndarray, " cluster"], Point]:
    """Terms at the best of closer and closer neighbours, each cluster's own, and where they are so."""
    spacing = trials.grid.spacing
    ways = np.array(list(itertools.product((-1, 0, 1), repeat=len(spacing))))
    clusters = np.arange(len(entries))
    terms = turn = np.zeros(len(entries))
    for halving in range(1, _FINER + 1):
        fields = entries + ways[:, None] * spacing / 2**halving
        told, turned = trials(fields)
        every = _pooled(told, null, touched)
        chosen = every.argmax(axis=0)
        entries, terms, turn = fields[chosen, clusters], every[chosen, clusters], turned[chosen, clusters]
    return terms, Point(entries, turn)
