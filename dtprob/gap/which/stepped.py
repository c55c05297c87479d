"""Places where an effect acts by a step, such as the time since when: data tell of them without any derivative."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting.active import Active
from dtprob.gap.fitting.density import moved, system_at, value_of
from dtprob.gap.fitting.fit import Fit, lowest_steps
from dtprob.gap.fitting.newton import newton_step
from dtprob.gap.model.problem import Problem

_POINTS: Final = 33
_FAR: Final = 3.0
"""Places that are looked at, twice, first so many standard deviations of the prior to either side."""
_LIKELY: Final = 6.0
"""Nats below the best within which places are looked at more closely."""


def stepped(problem: Problem, active: Active, fitted: Fit) -> tuple[int, ...]:
    """Which of a fit's global coordinates are places that no datum changes with, however little they move."""
    found: list[int] = []
    for effect in (e for e in active.effects if e.kind == "mean"):
        for parameter in (p for p in effect.parameters if p.is_place):
            index = problem.layout[effect.site_name(parameter.name)].index[0]
            directions = np.zeros((len(index), problem.dimension))
            directions[np.arange(len(index)), index] = 1.0
            slopes = np.asarray(problem.compiled.linearised(fitted.x, directions)[1])
            found += index[~slopes.any(axis=(0, 1))].tolist()
    return tuple(np.searchsorted(fitted.global_index, found).tolist())


def place_draws(
    problem: Problem, active: Active, fitted: Fit, coordinate: int, *, count: int, rng: np.random.Generator
) -> Float[np.ndarray, " count"]:
    """Draws of such a place from the density around the fit, at each place the best of all else by one Newton step.

    Args:
        problem: in which the fit's effects are live.
        active: the coordinates of the fit.
        fitted: the fit.
        coordinate: the place, among its global coordinates.
        count: how many draws.
        rng: what draws.
    """
    index = fitted.global_index[coordinate]
    at, half = float(fitted.x[index]), _FAR * float(np.sqrt(fitted.covariance[coordinate, coordinate]))

    def looked_at(low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
        points = np.linspace(low, high, _POINTS)
        return points, np.array([_value(problem, active, fitted.x, coordinate, point) for point in points])

    coarse, values = looked_at(at - half, at + half)
    likely, spacing = coarse[values > values.max() - _LIKELY], float(coarse[1] - coarse[0])
    points, values = looked_at(float(likely.min()) - spacing, float(likely.max()) + spacing)
    chances = np.exp(values - values.max())
    chosen = rng.choice(points, count, p=chances / chances.sum())
    return chosen + (points[1] - points[0]) * rng.uniform(-0.5, 0.5, count)


def _value(problem: Problem, active: Active, x: np.ndarray, coordinate: int, point: float) -> float:
    """The log posterior with the place there, all else moved by one step."""
    x = x.copy()
    x[active.global_index[coordinate]] = point
    before, system = value_of(problem, active, x), system_at(problem, active, x)
    if not system.finite:
        return before
    gradient = system.gradient.copy()
    gradient[coordinate] = 0.0  # it stays
    step = newton_step(replace(system, gradient=gradient), 0.0, lowest_steps(problem, active, x))
    return max(before, value_of(problem, active, moved(problem, active, x, step)))
