"""Cluster-local coordinates out of wrong basins: angles, few others, and what is found only together with an angle.

A delay turns a narrow-band signal, so a link's delay and phase have many optima that neither leaves alone; where only
powers are seen, a delay far from its place has no slope. Clusters are independent given the shared coordinates: one set
of trials serves all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dtprob.gap.model.problem import Problem

type Terms = Callable[[np.ndarray], np.ndarray]
"""The flat vector -> what each cluster adds to the log posterior (cluster,)."""

_ANGLES: Final = 8
_ROUNDS: Final = 2
_PLACES: Final = 13
_REACH: Final = 3.0
_MOST: Final = 4
"""Pairs of an angle and another coordinate up to which they are looked for together; coordinates without an angle."""
_BEND: Final = 3.0
"""Nats by which the mean of two places has to lie above the one between them, twice over."""
_LOWEST: Final = -1e9
_STEPS: Final = (-3.0, -1.5, 1.5, 3.0)
"""How far coordinates are moved beside one that may have several optima, in standard deviations of their prior."""


class _Local(NamedTuple):
    """Positions of the base model's cluster-local coordinates, (cluster,) each, and of what blocks they are part."""

    name: str
    positions: Int[np.ndarray, " cluster"]
    is_angle: bool


def swept(problem: Problem, x: Float[np.ndarray, " dimension"], terms: Terms) -> np.ndarray:
    """The point where each cluster is best over the whole range of its few coordinates: one alone, or with an angle.

    Args:
        problem: the model on its data.
        x: flat vector; shared coordinates stay.
        terms: of the log posterior.
    """
    found = _locals(problem)
    turns = [one for one in found if one.is_angle]
    others = [one for one in found if not one.is_angle]
    if not others or max(len(turns), 1) * len(others) > _MOST:
        return x
    x, value = x.copy(), np.nan_to_num(terms(x), nan=-np.inf)
    for other in others:
        for pair in [(turn, other) for turn in turns] or [(other,)]:
            value = _together(problem, x, value, terms, pair)
    return x


def elsewhere(
    problem: Problem, x: Float[np.ndarray, " dimension"], terms: Terms
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points at which all clusters have one of their coordinates at the same place, with the terms there.

    Of coordinates that may have several optima only; at each place also the others are moved, one at a time: where a link's
    delay is another one, so is its gain.

    Args:
        problem: the model on its data.
        x: flat vector; all else stays.
        terms: of the log posterior.
    """
    found = _locals(problem)
    if len(found) > _MOST or any(one.is_angle for one in found):
        return []
    points: list[tuple[np.ndarray, np.ndarray]] = []
    for one in found:
        line = []
        for place in _places(problem, one.name):
            moved = x.copy()
            moved[one.positions] = place
            line.append((moved, np.nan_to_num(terms(moved), nan=-np.inf)))
        if _is_bent(np.stack([values for _, values in line])):
            points += line
            for other in (other for other in found if other is not one):
                points += [_moved(problem, point, other, by, terms) for point, _ in line for by in _STEPS]
    return points


def _moved(
    problem: Problem, x: np.ndarray, one: _Local, by: float, terms: Terms
) -> tuple[np.ndarray, np.ndarray]:
    """The point with a coordinate of all clusters moved, in standard deviations of its prior, and the terms there."""
    moved = x.copy()
    moved[one.positions] += by * problem.prior_spread.usual(problem.layout[one.name].index)[1]
    return moved, np.nan_to_num(terms(moved), nan=-np.inf)


def _is_bent(values: Float[np.ndarray, "place cluster"]) -> bool:
    """Whether the log posterior of any cluster bends upwards along the places, as no parabola with a peak does."""
    values = np.maximum(values, _LOWEST)
    return bool(np.any(values[2:] + values[:-2] - 2 * values[1:-1] > _BEND))


def combined(
    problem: Problem, points: Sequence[np.ndarray], best: Int[np.ndarray, " cluster"]
) -> Float[np.ndarray, " dimension"]:
    """The first point, each cluster's own coordinates from the point that is best for it."""
    x = points[0].copy()
    for one in _locals(problem):
        x[one.positions] = np.stack([point[one.positions] for point in points])[best, np.arange(len(best))]
    return x


def _together(
    problem: Problem, x: np.ndarray, value: np.ndarray, terms: Terms, coordinates: tuple[_Local, ...]
) -> np.ndarray:
    """Terms after clusters of x have taken their best places of the last coordinate, with an angle before it or without."""
    start, *turns, other = x.copy(), *coordinates
    for place in _places(problem, other.name):
        for angle in _circle() if turns else [0.0]:
            moved = start.copy()
            moved[other.positions] = place
            for turn in turns:
                moved[turn.positions] += angle
            value = _kept(x, value, moved, terms(moved), coordinates)
    return value


def turned(problem: Problem, x: Float[np.ndarray, " dimension"], terms: Terms) -> np.ndarray:
    """The point with angles where each cluster is best, found one after another.

    Args:
        problem: the model on its data.
        x: flat vector; all that is no cluster-local angle stays.
        terms: of the log posterior.
    """
    x = x.copy()
    for _ in range(_ROUNDS):
        for turn in (one for one in _locals(problem) if one.is_angle):
            start, value = x.copy(), np.full(problem.n_cluster, -np.inf)
            for angle in _circle():
                moved = start.copy()
                moved[turn.positions] += angle
                value = _kept(x, value, moved, terms(moved), (turn,))
    return x


def turns(problem: Problem) -> Float[np.ndarray, " turn"]:
    """By how much clusters' own angles are turned in trials; by nothing where they have none."""
    return _circle() if any(one.is_angle for one in _locals(problem)) else np.zeros(1)


def turned_by(
    problem: Problem, x: Float[np.ndarray, " dimension"], turn: Float[np.ndarray, " cluster"]
) -> Float[np.ndarray, " dimension"]:
    """The point with all of each cluster's own angles turned alike."""
    x = x.copy()
    for one in _locals(problem):
        if one.is_angle:
            x[one.positions] += turn
    return x


def _kept(
    x: np.ndarray, value: np.ndarray, moved: np.ndarray, new: np.ndarray, coordinates: tuple[_Local, ...]
) -> np.ndarray:
    """Terms after clusters that are better at a trial have taken its coordinates."""
    better = new > value
    for one in coordinates:
        x[one.positions[better]] = moved[one.positions[better]]
    return np.where(better, new, value)


def _locals(problem: Problem) -> list[_Local]:
    circular = {name for name, site in problem.declaration.latent.items() if site.is_circular}
    blocks = [block for block in problem.blocks_of(None) if block.local]
    return [_Local(b.name, b.index[:, j], b.name in circular) for b in blocks for j in range(b.size)]


def _places(problem: Problem, name: str) -> np.ndarray:
    """Where a coordinate may be, by its prior."""
    centre, scale = problem.prior_spread.usual(problem.layout[name].index)
    return centre + scale * np.linspace(-_REACH, _REACH, _PLACES)


def _circle() -> np.ndarray:
    return np.linspace(-np.pi, np.pi, _ANGLES, endpoint=False)
