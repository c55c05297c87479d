"""Phases that are tracked over more than a turn: a start in which turns are counted.

The likelihood of a phase knows no turns. States that follow one, all moved at once from the centre of their priors, take
each reading for the nearest one, and a track that has left its start by more than half a turn is fitted in a wrong turn,
with a slip on the way, which no small step undoes. Where the readings themselves go on from one to the next they say
which turn each is in: a normal density about readings so counted has one mode, and what it finds is a start.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any, Final

import jax
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Bool, Float
from numpyro.primitives import Messenger

from dtprob.effects.distributions import replace_base
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.marginal_mode import around, height_at
from dtprob.gap.fitting.states import states
from dtprob.gap.model.problem import Problem
from dtprob.models.arguments import within

_GOES_ON: Final = 0.5
"""Resultant length of the steps between readings from which their turns can be counted."""
_STEPS: Final = 12
"""Of the fit to counted readings, which is a start and need not arrive."""
_SERIES: Final = 3
"""Readings in a row from which they are a series."""


class _OnALine(Messenger):
    """Observes phases as numbers on a line, as uncertain as they are at the point where the fit stands."""

    def __init__(self, names: Collection[str]) -> None:
        super().__init__(None)
        self._names = names

    def process_message(self, msg: dict[str, Any]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        if msg["type"] == "sample" and msg["name"] in self._names:
            msg["fn"] = replace_base(msg["fn"], _normal)


def _normal(phase: Any) -> dist.Distribution:
    return dist.Normal(phase.loc, jax.lax.stop_gradient(phase.concentration**-0.5))


def unwound(problem: Problem, x: Float[np.ndarray, " dimension"]) -> list[np.ndarray]:
    """Where fits to readings with their turns counted lead from a point; nowhere where no turn is passed.

    Some move what clusters have of their own, and states, the others all. Where a column makes the clusters, turns are
    counted within each and over all of them, as of one oscillator that is looked at in windows.

    Args:
        problem: the model on its data.
        x: flat vector, as of the centre of the priors.
    """
    phases = {
        n: problem.declaration.observed[n].argument for n, f in problem.families.items() if f == "VonMises"
    }
    named = {n: argument for n, argument in phases.items() if argument is not None}
    column = None if problem.column is None else np.asarray(problem.data[problem.column])
    points: list[np.ndarray] = []
    tried: list[dict[str, np.ndarray]] = []
    for labels in [None] if column is None else [column, None]:
        numbers = {argument: _counted(problem, name, x, labels) for name, argument in named.items()}
        counted = {argument: one for argument, one in numbers.items() if one is not None}
        if counted and not any(_are_same(counted, other) for other in tried):
            tried.append(counted)
            points += _led(problem, x, named, counted)
    return points


def _are_same(one: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[n], other[n]) for n in one)


def _led(
    problem: Problem, x: np.ndarray, names: Collection[str], counted: Mapping[str, np.ndarray]
) -> list[np.ndarray]:
    """Where fits to counted readings lead."""
    model = within(problem.model, lambda: _OnALine(names))
    cluster = problem.column or problem.declaration.cluster
    line = Problem(model, {**problem.data, **counted}, problem.effects, cluster)
    start = line.translate(x, problem)
    found = [fitting.fit(line, start, steps=_STEPS).x]
    if states(line).blocks or activate(line).local_index.shape[1]:
        found.append(height_at(line, start, around(line))[0])
    return [problem.translate(point, line) for point in found if np.isfinite(point).all()]


def _counted(problem: Problem, name: str, x: np.ndarray, labels: np.ndarray | None) -> np.ndarray | None:
    """The readings of a site with their turns counted, along the axis on which they go on best; None without turns."""
    shown = problem.compiled.observations(x)[name].parameters["loc"]
    seen = np.asarray(problem.observed.values[name], float)
    expected = np.broadcast_to(np.asarray(shown, float), seen.shape)
    away = (seen - expected + np.pi) % (2 * np.pi) - np.pi
    counts = problem.observed.counted[name]
    tried = [_along(away, counts, axis, labels) for axis in range(seen.ndim)]
    found = [one for one in tried if one is not None]
    if not found:
        return None
    goes_on, numbers = max(found, key=lambda one: one[0])
    passes = np.any(np.abs(np.where(counts, numbers, 0.0)) > math.pi)
    return expected + numbers if goes_on > _GOES_ON and passes else None


def _along(
    away: np.ndarray, counts: Bool[np.ndarray, "*site"], axis: int, labels: np.ndarray | None
) -> tuple[float, np.ndarray] | None:
    """How far phases go on along an axis, each label by itself, and what they are with their turns counted."""
    length = away.shape[axis]
    group = np.zeros(length, int)
    if labels is not None and axis == 0 and len(labels) == length:
        group = np.unique(labels, return_inverse=True)[1]
    lines = np.moveaxis(away, axis, -1).reshape(-1, length)
    kept = np.moveaxis(counts, axis, -1).reshape(lines.shape)
    numbers, steps = lines.copy(), []
    for line, valid, into in zip(lines, kept, numbers, strict=True):
        for label in range(group.max() + 1):
            places = np.flatnonzero(valid & (group == label))
            if len(places) >= _SERIES:
                into[places] = np.unwrap(line[places])
                steps.append(np.exp(1j * np.diff(line[places])))
    if not steps:
        return None
    moved = numbers.reshape(np.moveaxis(away, axis, -1).shape)
    return float(np.abs(np.concatenate(steps).mean())), np.moveaxis(moved, -1, axis)
