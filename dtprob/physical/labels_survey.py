"""A survey of labels: received levels along a drive through a town, beside the map that the twin predicts them by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.physical.gaussian import Bench, Law

BLOCKS, ROWS = 8, 50
"""Legs of a drive, and labels of each."""
EAST, NORTH = 600.0, 400.0
"""The town, m."""
_LEG_MINUTES: Final = 6.0
_WAVES: Final = 60
_SHADOW_DB, _SHADOW_LENGTH = 6.0, 60.0
_MAST: Final = 15.0


@dataclass(frozen=True)
class Survey:
    """One drive.

    Attributes:
        x: east and north, m, and minutes since the start, of each row.
        prediction: level that the twin's map has there, dBm.
        deviation: of a label from a right map, dB.
    """

    x: Float[np.ndarray, "row feature"]
    prediction: Float[np.ndarray, " row"]
    deviation: float

    @property
    def bench(self) -> Bench:
        """The sound labels; the twin fits one standard deviation and nothing else."""
        identity = np.broadcast_to(np.eye(ROWS), (BLOCKS, ROWS, ROWS))
        sound = Law(self.prediction.reshape(BLOCKS, ROWS), self.deviation**2 * identity)
        none = np.zeros((BLOCKS, ROWS, 0))
        return Bench(
            sound, none, lambda logs: np.exp(2 * logs[0]) * identity, np.log([max(self.deviation, 1e-9)])
        )


def make_survey(rng: np.random.Generator) -> Survey:
    """Two sites, a shadowed map, and a drive that is more often near the sites than far from them."""
    sites = rng.uniform([60, 60], [EAST - 60, NORTH - 60], (2, 2))
    place = _drive(rng, sites)
    minutes = np.sort(rng.uniform(0, BLOCKS * _LEG_MINUTES, BLOCKS * ROWS))
    exponent, level = rng.uniform(2.5, 3.8), rng.uniform(-45, -30)
    distance = np.hypot(np.linalg.norm(place[:, None] - sites, axis=2), _MAST)
    strongest = np.max(level - 10 * exponent * np.log10(distance), axis=1)
    return Survey(np.column_stack([place, minutes]), strongest + _shadow(rng, place), rng.uniform(2.0, 5.0))


def _drive(rng: np.random.Generator, sites: Float[np.ndarray, "site 2"]) -> Float[np.ndarray, "row 2"]:
    """Legs from crossing to crossing; half of them lead to the neighbourhood of a site."""
    town = np.array([EAST, NORTH])
    stops = [rng.uniform(0, town)]
    for leg in range(BLOCKS):
        near = sites[rng.integers(len(sites))] + 60 * rng.standard_normal(2)
        stops.append(np.clip(near, 0, town) if leg % 2 else rng.uniform(0, town))
    share = (np.arange(ROWS) + rng.uniform(0, 1, (BLOCKS, ROWS))) / ROWS
    corners = np.array(stops)
    legs = corners[:-1, None] + share[..., None] * (corners[1:] - corners[:-1])[:, None]
    return np.clip(legs + 4 * rng.standard_normal(legs.shape), 0, town).reshape(-1, 2)


def _shadow(rng: np.random.Generator, place: Float[np.ndarray, "row 2"]) -> Float[np.ndarray, " row"]:
    """A smooth random field, by random plane waves."""
    waves = rng.standard_normal((_WAVES, 2)) / _SHADOW_LENGTH
    phase = rng.uniform(0, 2 * np.pi, _WAVES)
    return _SHADOW_DB * np.sqrt(2 / _WAVES) * np.cos(place @ waves.T + phase).sum(axis=1)
