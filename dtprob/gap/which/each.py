"""Random fields of which each cluster has a few entries, these found cluster by cluster far from the null.

A receiver that stands wavelengths away from where it was recorded has turned its phases by many cycles: no score sees it,
and all that is left looks like noise. Clusters are independent given what they share, so one set of trials, each with the
same entries in all clusters, serves all of them. Where clusters have angles of their own (a phase of each packet), all of a
cluster's are turned alike beside each trial: what a place does to the phase is the same in every packet.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.plausible import scales, sizes
from dtprob.gap.fitting.sweep import turned_by, turns
from dtprob.gap.model.problem import Problem
from dtprob.gap.which.directions import Surroundings, surroundings
from dtprob.gap.which.scan import Found, centre

_ENTRIES: Final = 3
"""Entries that a cluster may have, at most."""
_REACH: Final = 3.0
"""Standard deviations of the largest plausible spread up to which entries are looked for."""
_LINE: Final = 193
_PER_WAVE: Final = 4
"""Trials for each peak along one entry."""
_FLAT: Final = 1.0
"""Nats below which an entry does not matter to a cluster."""
_FAR_BELOW: Final = 1e6
"""Nats below the best that count as all the same."""
_TRIALS: Final = 8192
_WORK: Final = 100_000_000
"""Combinations of entries that are tried, at most, and observations in all of these; beyond, they reach less far."""
_PEAKS: Final = 6
"""Highest peaks of each cluster that are looked at more finely."""
_FINER: Final = 3
"""Times that they are, by trials half as far apart."""


class _Grid(NamedTuple):
    """Entries to try, all combinations of some along each of them, and how far these are apart."""

    points: Float[np.ndarray, "trial entry"]
    counts: tuple[int, ...]
    spacing: Float[np.ndarray, " entry"]


class _Point(NamedTuple):
    """Entries of each cluster's field, and by how much all of its own angles are turned beside them."""

    entries: Float[np.ndarray, "cluster entry"]
    turn: Float[np.ndarray, " cluster"]


def scan_each(problem: Problem, x: np.ndarray, names: Sequence[str]) -> dict[str, Found]:
    """Random fields with each cluster's entries where they are best, or nowhere if what they gain there may be chance.

    Only those whose entries have several optima, which a fit from the null does not find, and that any cluster has entries
    of. What clusters share stands once at the fit and once at the centre of its prior, as in `scan`.

    Args:
        problem: the model and candidates on their data.
        x: the fit.
        names: candidates to look at.
    """
    effects = [e for e in problem.effects if e.name in names and _is_each(problem, e)]
    here, found = float(problem.compiled.by_cluster(x).sum()), dict[str, Found]()
    for anchor in (x, centre(problem, x)) if effects else ():
        around, null = surroundings(problem, anchor), problem.compiled.by_cluster(anchor)
        for effect in effects:
            tried = _Trials(problem, around, effect)
            grid = _grid(tried)
            if max(grid.counts) <= _number(1):
                continue
            value, point = _best(tried, grid, null)
            gain = float(value.sum()) - here
            is_best = effect.name not in found or gain > found[effect.name].gain
            if point.entries.any() and is_best:
                found[effect.name] = Found(gain, turned_by(problem, anchor, point.turn), point.entries)
    return found


def _best(tried: _Trials, grid: _Grid, null: Float[np.ndarray, " cluster"]) -> tuple[np.ndarray, _Point]:
    """Terms (cluster,) where entries and angles are best, the choice among trials paid for, and what these are."""
    price = float(np.log(len(grid.points)))
    value, kept = null, _Point(np.zeros((len(null), tried.entries)), np.zeros(len(null)))
    for peak in _peaks(grid, tried):
        terms, point = _refined(tried, peak, grid.spacing)
        is_better = terms - price > value
        value = np.where(is_better, terms - price, value)
        kept = _Point(
            np.where(is_better[:, None], point.entries, kept.entries),
            np.where(is_better, point.turn, kept.turn),
        )
    return value, kept


def _is_each(problem: Problem, effect: Effect) -> bool:
    """Whether an effect is a random field of which every cluster has a few entries of its own."""
    if effect.kind == "mean" or effect.is_looked_for or not effect.rewrites:
        return False
    size = int(np.prod(problem.field_shapes[effect.name], dtype=int))
    return problem.axis_of_clusters(effect) is not None and size <= _ENTRIES * problem.n_cluster


class _Trials:
    """What clusters add to the log posterior with entries of an effect's field at given values."""

    def __init__(self, problem: Problem, around: Surroundings, effect: Effect) -> None:
        self.problem, self.effect, self.values = problem, effect, around.grown()
        self.shape, self.axis = problem.field_shapes[effect.name], problem.axis_of_clusters(effect) or 0
        self.entries = int(np.prod(self.shape, dtype=int)) // problem.n_cluster
        self.spread = float(scales(effect)[sizes(effect)].max())
        self.turns = turns(problem)
        self.points = [turned_by(problem, around.x, np.full(problem.n_cluster, turn)) for turn in self.turns]

    def __call__(
        self, fields: Float[np.ndarray, "trial cluster entry"]
    ) -> tuple[Float[np.ndarray, "trial cluster"], Float[np.ndarray, "trial cluster"]]:
        """Terms of the log posterior, -inf where they are not finite, and how far angles are turned for these."""
        rest = tuple(n for i, n in enumerate(self.shape) if i != self.axis)
        given = np.moveaxis(fields.reshape(len(fields), -1, *rest), 1, 1 + self.axis)
        parts = []
        for part, shifts in self.problem.programs.field_shifts(self.effect.name, self.values, given):
            count = part.stop - part.start
            parts.append(np.stack([self.problem.compiled.shifted(x, shifts, count) for x in self.points]))
        values = np.nan_to_num(np.concatenate(parts, axis=1), nan=-np.inf, posinf=-np.inf)
        return values.max(axis=0), self.turns[values.argmax(axis=0)]


def _grid(tried: _Trials) -> _Grid:
    """Entries as close together as each alone makes the log posterior wave, the null among them."""
    offsets = np.linspace(-_REACH, _REACH, _LINE) * tried.spread
    counts = []
    for j in range(tried.entries):
        fields = np.zeros((_LINE, tried.problem.n_cluster, tried.entries))
        fields[:, :, j] = offsets[:, None]
        counts.append(_count(tried(fields)[0]))
    spacing = 2 * _REACH * tried.spread / np.maximum(np.array(counts) - 1, 1)
    most = min(_TRIALS, max(_WORK // (tried.problem.n_observation * len(tried.turns)), _LINE))
    while np.prod(counts) > most:
        counts[int(np.argmax(counts))] -= 2
    lines = [step * np.arange(-(n // 2), n // 2 + 1) for n, step in zip(counts, spacing, strict=True)]
    points = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, tried.entries)
    return _Grid(points, tuple(counts), spacing)


def _count(values: Float[np.ndarray, "trial cluster"]) -> int:
    """How many trials there are along one entry, from the peaks of the cluster that has most of them; 1 if none matters."""
    told = values[:, np.ptp(np.maximum(values, values.max(axis=0) - _FAR_BELOW), axis=0) > _FLAT]
    if not told.size:
        return 1
    peaks = (told[1:-1] > told[:-2]) & (told[1:-1] >= told[2:])
    return _number(max(int(peaks.sum(axis=0).max()), 1))


def _number(peaks: int) -> int:
    """An odd number of trials for so many peaks, so that the null is among them."""
    return 2 * (_PER_WAVE * peaks // 2) + 1


def _peaks(grid: _Grid, tried: _Trials) -> Iterator[Float[np.ndarray, "cluster entry"]]:
    """Entries at each cluster's highest peak, then at its second, and so on."""
    values, _ = tried(np.repeat(grid.points[:, None], tried.problem.n_cluster, axis=1))
    shaped = values.reshape(*grid.counts, -1)
    around = ndimage.maximum_filter(shaped, size=(*(3 for _ in grid.counts), 1), mode="nearest")
    peaks = np.where(shaped >= around, shaped, -np.inf).reshape(values.shape)
    for chosen in np.argsort(-peaks, axis=0)[:_PEAKS]:
        yield grid.points[chosen]


def _refined(
    tried: _Trials, entries: Float[np.ndarray, "cluster entry"], spacing: Float[np.ndarray, " entry"]
) -> tuple[np.ndarray, _Point]:
    """Terms (cluster,) at the best of closer and closer neighbours, each cluster's own, and where they are so."""
    ways, clusters = (
        np.array(list(itertools.product((-1, 0, 1), repeat=len(spacing)))),
        np.arange(len(entries)),
    )
    terms = turns = np.zeros(len(entries))
    for halving in range(1, _FINER + 1):
        fields = entries + ways[:, None] * spacing / 2**halving
        every, turned = tried(fields)
        chosen = every.argmax(axis=0)
        entries, terms, turns = fields[chosen, clusters], every[chosen, clusters], turned[chosen, clusters]
    return terms, _Point(entries, turns)
