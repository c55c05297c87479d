"""Runs along a road whose power fades slowly, and what can be wrong with a stationary fading of first order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.errors import unknown_name
from dtprob.physical.gaussian import Bench, Covariance, Fault, Law, Vector, shifted

RUNS, STEPS = 40, 20
"""Runs, and readings in each."""
_LARGEST_DB: Final = 25.0
_BURST: Final = 4
"""Steps of a burst."""


@dataclass(frozen=True)
class Runs:
    """One campaign.

    Attributes:
        distance: from the base station, m.
        level: power at 1 m, dBm.
        exponent: of the distance.
        correlation: of the fading at two steps in a row.
        fading, noise: standard deviations, dB.
    """

    distance: Vector
    level: float
    exponent: float
    correlation: float
    fading: float
    noise: float

    @property
    def bench(self) -> Bench:
        """The sound measurement; the twin fits level, exponent, correlation and both deviations."""
        slope = -10 * np.log10(self.distance)

        def covariance(logs: np.ndarray) -> Covariance:
            memory = np.exp(-np.exp(logs[0]) * _lags(np.arange(STEPS, dtype=float)))
            one = np.exp(2 * logs[1]) * memory + np.exp(2 * logs[2]) * np.eye(STEPS)
            return np.broadcast_to(one, (RUNS, STEPS, STEPS))

        start = np.log([-np.log(self.correlation), self.fading, self.noise])
        tangents = np.stack([np.ones_like(slope), slope], axis=-1)
        return Bench(Law(self.level + self.exponent * slope, covariance(start)), tangents, covariance, start)

    def faded(self, deviation: Float[np.ndarray, " step"], clock: Float[np.ndarray, " step"]) -> Covariance:
        """Covariance of readings whose fading has another deviation at each step, or forgets by another clock."""
        memory = self.correlation ** _lags(clock)
        one = deviation[:, None] * memory * deviation + self.noise**2 * np.eye(STEPS)
        return np.broadcast_to(one, (RUNS, STEPS, STEPS))


def make_runs(rng: np.random.Generator) -> Runs:
    """Runs that start at places of their own and lead away from the base station."""
    begin, pace = rng.uniform(60, 300, (RUNS, 1)), rng.uniform(3, 8, (RUNS, 1))
    return Runs(
        begin + pace * np.arange(STEPS),
        rng.uniform(-45, -25),
        rng.uniform(2.6, 3.6),
        rng.uniform(0.5, 0.8),
        rng.uniform(3.0, 6.0),
        rng.uniform(1.0, 2.0),
    )


def _lags(clock: Float[np.ndarray, " step"]) -> Float[np.ndarray, "step step"]:
    return np.abs(clock[:, None] - clock)


_SHARE: Final = np.linspace(0.0, 1.0, STEPS)
_LATE: Final = 0.5 * (1 + np.tanh((_SHARE - 0.5) / 0.02))
"""One in the second half of a run, after a short crossing."""


def _handover(rng: np.random.Generator, _runs: Runs) -> Fault:
    """Half-way another station takes over, whose power is not the first one's."""
    after = 1.0 * (np.arange(STEPS) >= STEPS // 2)
    return Fault("handover", None, "dB", _LARGEST_DB, shifted(rng.choice([-1, 1]) * _all(after)))


def _gain_drift(rng: np.random.Generator, _runs: Runs) -> Fault:
    """A receiver that warms up in each run."""
    warm = (1 - np.exp(-_SHARE / 0.8)) / (1 - np.exp(-1 / 0.8))
    return Fault("gain_drift", None, "dB", _LARGEST_DB, shifted(rng.choice([-1, 1]) * _all(warm)))


def _speed_change(_rng: np.random.Generator, runs: Runs) -> Fault:
    """The second half is driven faster, so that shadows pass sooner."""

    def change(law: Law, size: float) -> Law:
        return _with_fading(runs, law, pace=1 + size * _LATE)

    return Fault("speed_change", None, "1", 12.0, change)


def _rising_noise(_rng: np.random.Generator, _runs: Runs) -> Fault:
    """An amplifier that grows noisier, its noise power in proportion to the time."""

    def change(law: Law, size: float) -> Law:
        return replace(law, covariance=law.covariance + np.diag(size**2 * _SHARE))

    return Fault("rising_noise", None, "dB", 20.0, change)


def _deeper_fading(_rng: np.random.Generator, runs: Runs) -> Fault:
    """Taller houses along the second half."""

    def change(law: Law, size: float) -> Law:
        return _with_fading(runs, law, depth=1 + size * _LATE)

    return Fault("deeper_fading", None, "1", 5.0, change)


def _periodic_gain(rng: np.random.Generator, _runs: Runs) -> Fault:
    """A gain that is switched to and fro every few steps, at the same steps in every run."""
    shape = np.sign(np.sin(2 * np.pi * (np.arange(STEPS) + rng.uniform(0, 7)) / 7))
    return Fault("periodic_gain", None, "dB", _LARGEST_DB, shifted(_all(shape)))


def _bursts(rng: np.random.Generator, _runs: Runs) -> Fault:
    """A stranger's bursts add power: two in each run, anywhere."""
    start = rng.integers(0, STEPS - _BURST + 1, (RUNS, 2, 1))
    steps = np.arange(STEPS)
    inside = ((steps >= start) & (steps < start + _BURST)).any(axis=1)
    return Fault("bursts", None, "dB", _LARGEST_DB, shifted(1.0 * inside))


def _own_level(_rng: np.random.Generator, _runs: Runs) -> Fault:
    """The receiver is set anew for each run and never comes out alike."""

    def change(law: Law, size: float) -> Law:
        return replace(law, covariance=law.covariance + size**2)

    return Fault("own_level", None, "dB", _LARGEST_DB, change)


def _all(shape: Float[np.ndarray, " step"]) -> Vector:
    """The same shape in all runs."""
    return np.broadcast_to(shape, (RUNS, STEPS))


@dataclass(frozen=True)
class _Faded(Law):
    """A law whose fading runs otherwise.

    Attributes:
        depth: of the fading at each step, over the sound one.
        pace: of the clock by which it forgets, likewise.
    """

    depth: Float[np.ndarray, " step"]
    pace: Float[np.ndarray, " step"]


def _with_fading(
    runs: Runs,
    law: Law,
    *,
    depth: Float[np.ndarray, " step"] | float = 1.0,
    pace: Float[np.ndarray, " step"] | float = 1.0,
) -> Law:
    """A law whose fading is so much deeper and faster than it was; what other faults added to the covariance is kept."""
    even = np.ones(STEPS)
    before = (
        law if isinstance(law, _Faded) else _Faded(law.mean, law.covariance, even, even, ceiling=law.ceiling)
    )
    after = replace(before, depth=before.depth * depth, pace=before.pace * pace)
    old, new = (runs.faded(runs.fading * one.depth, np.cumsum(one.pace)) for one in (before, after))
    return replace(after, covariance=law.covariance - old + new)


_DRAWS: Final[dict[str, Callable[[np.random.Generator, Runs], Fault]]] = {
    "handover": _handover,
    "gain_drift": _gain_drift,
    "speed_change": _speed_change,
    "rising_noise": _rising_noise,
    "deeper_fading": _deeper_fading,
    "periodic_gain": _periodic_gain,
    "bursts": _bursts,
    "own_level": _own_level,
}
FAMILIES: Final = tuple(_DRAWS)
FOREIGN: Final = ("periodic_gain", "bursts", "own_level")
"""Families that the user's effects lack."""


def draw(rng: np.random.Generator, family: str, runs: Runs) -> Fault:
    """One fault of a family.

    Args:
        rng: source of randomness.
        family: name of the physics.
        runs: where it happens.

    Raises:
        InputError: an unknown family.
    """
    if family not in _DRAWS:
        raise unknown_name("fault", family, _DRAWS, "family of faults")
    return _DRAWS[family](rng, runs)
