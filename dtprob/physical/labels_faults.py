"""What can be wrong between labels and the map that predicts them, each as its own physics has it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.errors import unknown_name
from dtprob.physical.gaussian import Fault, Law, louder, shifted
from dtprob.physical.labels_survey import BLOCKS, EAST, NORTH, ROWS, Survey

type Rows = Float[np.ndarray, " row"]

_ZONES: Final = {"low": (0.0, 1 / 3), "middle": (1 / 3, 2 / 3), "high": (2 / 3, 1.0)}
_EDGE: Final = 0.01
"""Width of a zone's edge, as a share of the feature's range."""
_DISTRICTS: Final = 24
_LARGEST_DB: Final = 25.0
_UNREACHED: Final = 5.0
"""Standard deviations by which no label lies above the map."""


def _zone(rng: np.random.Generator, survey: Survey) -> tuple[str, Rows]:
    """A third of a feature with soft edges that are where planners drew them, not at the samples' quantiles."""
    feature = int(rng.integers(survey.x.shape[1]))
    name = str(rng.choice(list(_ZONES)))
    column = survey.x[:, feature]
    low, high = (
        float(np.quantile(column, np.clip(q + 0.015 * rng.standard_normal(), 0, 1))) for q in _ZONES[name]
    )
    width = _EDGE * np.ptp(column)
    inside = np.ones(len(column))
    if name != "low":
        inside = inside * _logistic((column - low) / width)
    if name != "high":
        inside = inside * _logistic((high - column) / width)
    return f"x{feature}_{name}", inside


def _regional_bias(rng: np.random.Generator, survey: Survey) -> Fault:
    """A cable's loss, a district behind a new dam, or an instrument that warms up."""
    kind = rng.choice(["everywhere", "zone", "slope"], p=[0.2, 0.5, 0.3])
    if kind == "zone":
        instance, shape = _zone(rng, survey)
    elif kind == "slope":
        feature = int(rng.integers(survey.x.shape[1]))
        column = survey.x[:, feature]
        u = 2 * (column - column.min()) / np.ptp(column) - 1
        instance, shape = f"x{feature}_slope", u + 0.1 * (u**2 - 1 / 3)
    else:
        minutes = survey.x[:, 2]
        instance, shape = "everywhere", 1 + 0.1 * np.cos(2 * np.pi * minutes / np.ptp(minutes))
    return Fault("regional_bias", instance, "dB", _LARGEST_DB, shifted(_blocks(rng.choice([-1, 1]) * shape)))


def _scale_bias(rng: np.random.Generator, survey: Survey) -> Fault:
    """A logarithmic detector with a wrong slope, right near the middle of its range only."""
    pivot = (survey.prediction.max() + survey.prediction.min()) / 2 + 2 * rng.standard_normal()
    sign = rng.choice([-1, 1])
    return Fault("scale_bias", None, "1", 0.6, shifted(_blocks(sign * (survey.prediction - pivot))))


def _label_noise(rng: np.random.Generator, survey: Survey) -> Fault:
    """Fewer samples are averaged in a zone, so that its labels scatter more."""
    instance, shape = _zone(rng, survey)
    return Fault("label_noise", instance, "ln 1", 2.0, louder(_blocks(shape)))


def _stale_map(rng: np.random.Generator, survey: Survey) -> Fault:
    """The town was built over since: districts, the ground nearest to each of some centres, have levels of their own."""
    centres = rng.uniform(0, [EAST, NORTH], (_DISTRICTS, 2))
    nearest = np.argmin(np.linalg.norm(survey.x[:, None, :2] - centres, axis=2), axis=1)
    offsets = rng.standard_normal(_DISTRICTS)
    return Fault("stale_map", None, "dB", _LARGEST_DB, shifted(_blocks(offsets[nearest])))


def _saturation(_rng: np.random.Generator, survey: Survey) -> Fault:
    """A receiver near a site cannot show more than its largest level.

    Size is how far that lies below a level that no label reaches, some deviations above the strongest prediction.
    """
    above = _UNREACHED * survey.deviation
    strongest = float(survey.prediction.max()) + above

    def change(law: Law, size: float) -> Law:
        return replace(law, ceiling=min(law.ceiling, strongest - size))

    return Fault("saturation", None, "dB", above + 32.0, change)


def _swapped_segments(rng: np.random.Generator, survey: Survey) -> Fault:
    """Two stretches of the drive were filed under each other's place; size is the share of a leg that each takes."""
    first, second = rng.choice(BLOCKS, 2, replace=False)
    levels = survey.prediction.reshape(BLOCKS, ROWS)

    def change(law: Law, size: float) -> Law:
        length, mean = round(size * ROWS), law.mean.copy()
        mean[first, :length] += levels[second, :length] - levels[first, :length]
        mean[second, :length] += levels[first, :length] - levels[second, :length]
        return replace(law, mean=mean)

    detail = {"legs": [int(first), int(second)]}
    return Fault("swapped_segments", None, "1", 1.0, change, detail)


def _autocorrelated_errors(_rng: np.random.Generator, _survey: Survey) -> Fault:
    """Neighbours along a leg err alike; size is the correlation of two in a row."""
    lag = np.abs(np.subtract.outer(np.arange(ROWS), np.arange(ROWS)))

    def change(law: Law, size: float) -> Law:
        scale = np.sqrt(np.einsum("bii->bi", law.covariance))
        return replace(law, covariance=scale[:, :, None] * size**lag * scale[:, None, :])

    return Fault("autocorrelated_errors", None, "1", 0.98, change)


def _periodic_bias(rng: np.random.Generator, survey: Survey) -> Fault:
    """The sender's power is cycled with the load, several times on each leg: too fast for a map of places to follow."""
    periods, phase = BLOCKS * int(rng.integers(4, 9)), rng.uniform(0, 2 * np.pi)
    minutes = survey.x[:, 2]
    shape = np.sin(2 * np.pi * periods * minutes / np.ptp(minutes) + phase)
    return Fault("periodic_bias", None, "dB", _LARGEST_DB, shifted(_blocks(shape)), {"periods": periods})


def _blocks(rows: Rows) -> Float[np.ndarray, "block row"]:
    return np.asarray(rows, float).reshape(BLOCKS, ROWS)


def _logistic(value: Rows) -> Rows:
    return 0.5 * (1 + np.tanh(value / 2))


_DRAWS: Final[dict[str, Callable[[np.random.Generator, Survey], Fault]]] = {
    "regional_bias": _regional_bias,
    "scale_bias": _scale_bias,
    "label_noise": _label_noise,
    "stale_map": _stale_map,
    "saturation": _saturation,
    "swapped_segments": _swapped_segments,
    "autocorrelated_errors": _autocorrelated_errors,
    "periodic_bias": _periodic_bias,
}
FAMILIES: Final = tuple(_DRAWS)
FOREIGN: Final = ("saturation", "swapped_segments", "autocorrelated_errors", "periodic_bias")
"""Families that no library of effects has."""
LISTED: Final = tuple(name for name in FAMILIES if name not in FOREIGN)


def draw(rng: np.random.Generator, family: str, survey: Survey) -> Fault:
    """One fault of a family, its place at random.

    Args:
        rng: source of randomness.
        family: name of the physics.
        survey: where it happens.

    Raises:
        InputError: an unknown family.
    """
    if family not in _DRAWS:
        raise unknown_name("fault", family, _DRAWS, "family of faults")
    return _DRAWS[family](rng, survey)
