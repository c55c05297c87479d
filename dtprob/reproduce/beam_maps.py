"""Channel knowledge maps: what paths, or what labels, a position has, judged by a few known positions."""

from collections.abc import Callable
from functools import partial
from typing import Final

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy import linalg
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from dtprob.reproduce.beams import BeamPaths, Site
from dtprob.reproduce.beams_codebook import Arrays, labels

NEIGHBOURS: Final = 3
MAPPED_PATHS: Final = 3
LENGTHS: Final = (0.1, 0.2, 0.4)
_NOISE: Final = 0.01
_RADIAL: Final = 1.5
_JUDGED: Final = 300
_ROWS: Final = 4096

type Map = Callable[
    [BeamPaths, Float[np.ndarray, "sought 2"], Arrays],
    Float[np.ndarray, "sought entry"],
]
"""From known positions with their paths to the labels of sought positions."""


def inverse_distance(
    known: BeamPaths, sought: Float[np.ndarray, "sought 2"], arrays: Arrays
) -> Float[np.ndarray, "sought entry"]:
    """The labels of interpolated paths."""
    return np.concatenate([labels(interpolated(known, part), arrays) for part in _parts(sought)])


def interpolated(known: BeamPaths, sought: Float[np.ndarray, "sought 2"]) -> BeamPaths:
    """The strongest paths interpolated from the nearest positions, by inverse distances; phases are lost."""
    count = min(NEIGHBOURS, len(known.position))
    nearest = np.arange(1, count + 1)
    distance, index = KDTree(known.position).query(sought, k=nearest)  # pyright: ignore[reportArgumentType]
    closeness = 1 / np.maximum(distance, 1e-6)
    share = (closeness / closeness.sum(axis=1, keepdims=True))[..., None]
    amplitude = np.abs(known.gain[:, :MAPPED_PATHS])[index]
    there = share * (amplitude > 0)
    whole = np.where(there.sum(axis=1) > 0, there.sum(axis=1), 1.0)

    def mean(cosine: Float[np.ndarray, "known path"]) -> Float[np.ndarray, "sought path"]:
        return np.sum(there * cosine[:, :MAPPED_PATHS][index], axis=1) / whole

    power = np.sum(share * amplitude**2, axis=1)
    directions = mean(known.horizontal), mean(known.vertical), mean(known.arrival)
    return BeamPaths(sought, np.sqrt(power), *directions)


def gaussian_process(
    known: BeamPaths, sought: Float[np.ndarray, "sought 2"], arrays: Arrays
) -> Float[np.ndarray, "sought entry"]:
    """The labels' posterior mean under a Gaussian process over direction and logarithm of the distance.

    Its kernel is exponential, as suits what jumps at the edges of shadows; its length is the one that predicts
    known labels best, each from the others.
    """
    place, target = polar(known.position), labels(known, arrays)
    middle = target.mean(axis=0)
    length = min(LENGTHS, key=partial(_left_out_error, place[:_JUDGED], (target - middle)[:_JUDGED]))
    gram = _kernel(place, place, length) + _NOISE * np.eye(len(place))
    weight = linalg.solve(gram, target - middle, assume_a="pos")
    parts = (_kernel(polar(part), place, length) @ weight for part in _parts(sought))
    return np.concatenate(list(parts)) + middle


def _left_out_error(
    place: Float[np.ndarray, "known 3"], target: Float[np.ndarray, "known entry"], length: float
) -> float:
    """The mean squared error of each known label judged by the others."""
    inverse = np.linalg.inv(_kernel(place, place, length) + _NOISE * np.eye(len(place)))
    return float(np.mean((inverse @ target / np.diagonal(inverse)[:, None]) ** 2))


def _parts(sought: Float[np.ndarray, "sought 2"]) -> list[Float[np.ndarray, "part 2"]]:
    return [sought[start : start + _ROWS] for start in range(0, len(sought), _ROWS)]


def _kernel(
    one: Float[np.ndarray, "one 3"], other: Float[np.ndarray, "other 3"], length: float
) -> Float[np.ndarray, "one other"]:
    return np.exp(-cdist(one, other) / length)


MAPS: Final[dict[str, Map]] = {"inverse_distance": inverse_distance, "gaussian_process": gaussian_process}
"""The maps by name."""


def polar(position: Float[np.ndarray, "position 2"]) -> Float[np.ndarray, "position 3"]:
    """The direction from the base station, and two thirds of the logarithm of the distance."""
    step = position - np.array(Site().position[:2])
    distance = np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1.0)
    return np.concatenate([step / distance, np.log(distance) / _RADIAL], axis=1)


def waves(
    key: PRNGKeyArray, position: Float[np.ndarray, "position 2"], count: int, scale: float
) -> Float[np.ndarray, "position feature"]:
    """Random Fourier features of `polar`.

    Args:
        key: typed JAX key.
        position: horizontal, m.
        count: number of features.
        scale: over which they vary.
    """
    keys = jax.random.split(key)
    frequency = np.asarray(jax.random.normal(keys[0], (3, count))) / scale
    phase = np.asarray(jax.random.uniform(keys[1], (count,), maxval=2 * np.pi))
    return np.sqrt(2 / count) * np.cos(polar(position) @ frequency + phase)
