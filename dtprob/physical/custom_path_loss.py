"""Power measured street by street around one base station, and what can be wrong with a power law of distance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.errors import unknown_name
from dtprob.physical.gaussian import Bench, Fault, Law, Vector, louder, shifted

STREETS, ROWS = 40, 10
"""Streets, and measurements in each."""
BASE_STATION: Final = (400.0, 250.0, 25.0)
STREET_DB: Final = 2.0
"""Standard deviation of a street's own level, which the twin knows."""
_TOWN: Final = (800.0, 500.0)
_STREET_LENGTH: Final = 80.0
_MINUTES: Final = 90.0
_BREAK: Final = 150.0
_SHARP: Final = 6.0
"""How sharply the slope changes at the breakpoint."""
_LARGEST_DB: Final = 25.0


@dataclass(frozen=True)
class Streets:
    """One campaign.

    Attributes:
        place: east and north, m.
        minutes: since the start.
        level: power at 1 m, dBm.
        exponent: of the distance.
        error: standard deviation of one measurement, dB.
    """

    place: Float[np.ndarray, "street row 2"]
    minutes: Vector
    level: float
    exponent: float
    error: float

    @property
    def distance(self) -> Vector:
        """From the base station, m."""
        return _distance(self.place, np.array(BASE_STATION))

    @property
    def bench(self) -> Bench:
        """The sound measurement; the twin fits level, exponent and error."""
        slope = -10 * np.log10(self.distance)
        identity, alike = np.eye(ROWS), np.full((ROWS, ROWS), STREET_DB**2)

        def covariance(logs: np.ndarray) -> np.ndarray:
            return np.broadcast_to(alike + np.exp(2 * logs[0]) * identity, (STREETS, ROWS, ROWS))

        start = np.log([self.error])
        mean = self.level + self.exponent * slope
        tangents = np.stack([np.ones_like(slope), slope], axis=-1)
        return Bench(Law(mean, covariance(start)), tangents, covariance, start)


def make_streets(rng: np.random.Generator) -> Streets:
    """Streets of random place and direction, driven one after another."""
    centre = rng.uniform(40, np.array(_TOWN) - 40, (STREETS, 1, 2))
    angle = rng.choice([0.0, np.pi / 2], (STREETS, 1)) + 0.1 * rng.standard_normal((STREETS, 1))
    along = np.linspace(-0.5, 0.5, ROWS) * _STREET_LENGTH
    way = np.stack([np.cos(angle) * along, np.sin(angle) * along], axis=-1)
    minutes = np.sort(rng.uniform(0, _MINUTES, STREETS * ROWS)).reshape(STREETS, ROWS)
    return Streets(centre + way, minutes, rng.uniform(-45, -25), rng.uniform(2.6, 3.6), rng.uniform(1.5, 4.0))


def _distance(place: Float[np.ndarray, "street row 2"], station: Float[np.ndarray, " 3"]) -> Vector:
    return np.sqrt(np.sum((place - station[:2]) ** 2, axis=-1) + station[2] ** 2)


def _wall(rng: np.random.Generator, streets: Streets) -> Fault:
    """Behind a dam there is a shadow, which diffraction softens over some metres."""
    instance = str(rng.choice(["railway", "river"]))
    beyond = streets.place[..., 0] - 560 if instance == "railway" else streets.place[..., 1] - 360
    return Fault("wall", instance, "dB", _LARGEST_DB, shifted(-0.5 * (1 + np.tanh(beyond / 6))))


def _gain_drift(rng: np.random.Generator, streets: Streets) -> Fault:
    """A receiver that warms up: fast at first."""
    warm = 1 - np.exp(-streets.minutes / (0.8 * _MINUTES))
    return Fault("gain_drift", None, "dB", _LARGEST_DB, shifted(rng.choice([-1, 1]) * warm))


def _second_slope(_rng: np.random.Generator, streets: Streets) -> Fault:
    """Beyond the breakpoint of a plane earth power falls faster, the slope changing gradually."""
    bend = np.log10(1 + (streets.distance / _BREAK) ** _SHARP) / _SHARP
    return Fault("second_slope", None, "1", 6.0, shifted(-10 * bend))


def _sector(rng: np.random.Generator, streets: Streets) -> Fault:
    """The antenna is no omnidirectional one: a lobe, somewhat narrower than a cosine."""
    east, north = (streets.place[..., k] - BASE_STATION[k] for k in (0, 1))
    angle = np.arctan2(north, east) - rng.uniform(-np.pi, np.pi)
    return Fault("sector", None, "dB", _LARGEST_DB, shifted(np.cos(angle) + 0.15 * np.cos(2 * angle)))


def _base_station_moved(rng: np.random.Generator, streets: Streets) -> Fault:
    """The base station stands elsewhere than the plan says."""
    direction = rng.uniform(-np.pi, np.pi)
    way = np.array([np.cos(direction), np.sin(direction), 0.0])

    def change(law: Law, size: float) -> Law:
        moved = _distance(streets.place, np.array(BASE_STATION) + size * way)
        return replace(law, mean=law.mean - 10 * streets.exponent * np.log10(moved / streets.distance))

    return Fault("base_station_moved", None, "m", 120.0, change, {"direction": direction})


def _noise_with_distance(_rng: np.random.Generator, streets: Streets) -> Fault:
    """Weak signals are read less well: the error of one measurement grows with distance, in proportion at most."""

    def change(law: Law, size: float) -> Law:
        alike = np.full((ROWS, ROWS), STREET_DB**2)
        factor = (1 + size * streets.distance / _BREAK) / (1 + size)
        own = (law.covariance - alike) * factor[:, :, None] * factor[:, None, :]
        return replace(law, covariance=alike + own)

    return Fault("noise_with_distance", None, "1", 50.0, change)


def _ground_ripple(rng: np.random.Generator, streets: Streets) -> Fault:
    """The wave from the ground adds and cancels in turn with the distance."""
    phase = rng.uniform(0, 2 * np.pi)
    shape = np.sin(2 * np.pi * streets.distance / 60.0 + phase)
    return Fault("ground_ripple", None, "dB", _LARGEST_DB, shifted(shape))


def _swapped_streets(rng: np.random.Generator, streets: Streets) -> Fault:
    """Streets filed under each other's name; size is the number of pairs."""
    order = rng.permutation(STREETS)
    level = streets.bench.law.mean

    def change(law: Law, size: float) -> Law:
        mean = law.mean.copy()
        for first, second in order[: 2 * round(size)].reshape(-1, 2):
            mean[first] += level[second] - level[first]
            mean[second] += level[first] - level[second]
        return replace(law, mean=mean)

    return Fault("swapped_streets", None, "1", STREETS / 2, change)


def _gusts(rng: np.random.Generator, _streets: Streets) -> Fault:
    """In some streets the receiver shakes: their measurements scatter more, the others' do not."""
    shaken = rng.permutation(STREETS) < STREETS // 4
    shape = np.broadcast_to(shaken[:, None], (STREETS, ROWS)).astype(float)

    def change(law: Law, size: float) -> Law:
        alike = np.full((ROWS, ROWS), STREET_DB**2)
        own = louder(shape)(replace(law, covariance=law.covariance - alike), size)
        return replace(law, covariance=own.covariance + alike)

    return Fault("gusts", None, "ln 1", 2.0, change)


_DRAWS: Final[dict[str, Callable[[np.random.Generator, Streets], Fault]]] = {
    "wall": _wall,
    "gain_drift": _gain_drift,
    "second_slope": _second_slope,
    "sector": _sector,
    "base_station_moved": _base_station_moved,
    "noise_with_distance": _noise_with_distance,
    "ground_ripple": _ground_ripple,
    "swapped_streets": _swapped_streets,
    "gusts": _gusts,
}
FAMILIES: Final = tuple(_DRAWS)
FOREIGN: Final = ("ground_ripple", "swapped_streets", "gusts")
"""Families that the user's effects lack."""


def draw(rng: np.random.Generator, family: str, streets: Streets) -> Fault:
    """One fault of a family.

    Args:
        rng: source of randomness.
        family: name of the physics.
        streets: where it happens.

    Raises:
        InputError: an unknown family.
    """
    if family not in _DRAWS:
        raise unknown_name("fault", family, _DRAWS, "family of faults")
    return _DRAWS[family](rng, streets)
