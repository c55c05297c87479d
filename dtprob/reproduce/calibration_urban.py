"""An urban scene whose one material is to be found from channels between two arrays of 64 elements.

The truth is traced by `dtprob.physical`, the twin by `dtprob.raytracing`; both know the scene, and walls are half-spaces
on both sides (in the truth, slabs so thick that nothing returns from their backs).
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, PRNGKeyArray

from dtprob.physical.channel import Sounding, array_responses, path_channels, subcarriers
from dtprob.physical.rays import Rays
from dtprob.physical.tracing import scene_materials, trace
from dtprob.physical.world import SPEED_OF_LIGHT, Material, World, planar_array
from dtprob.raytracing.calibration import (
    SCHEMES,
    Calibration,
    Scheme,
    Settings,
    Statistics,
    calibrate_runs,
    project,
)
from dtprob.raytracing.field import path_gain
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.trace import load_scene
from dtprob.raytracing.trace import trace as trace_twin

SCENE: Final = "munich"
FREQUENCY: Final = 6e9
SPACING: Final = 30e3
SUBCARRIERS: Final = 64
SIDE: Final = 8
SNAPSHOTS: Final = 50
SNR_DB: Final = 20.0
DEPTH: Final = 10
RAYS: Final = 1_000_000
DISPLACED_RAYS: Final = 200_000
"""To displaced receivers, of whose paths these miss one, 47 dB below their sum."""
TRANSMITTER: Final = (8.5, 21.0, 27.0)
RECEIVER: Final = (-20.0, 70.0, 1.5)
"""Of the calibration, behind a corner: every path is reflected."""
TRUE: Final = Material(5.31, 0.139, 10.0)
"""Concrete at 6 GHz, ITU-R P.2040-1."""
TESTS: Final = 20
"""Receivers in the streets around the transmitter, which calibration has not seen."""
TEST_RAYS: Final = 200_000


NOTES: Final = (
    (
        f"Scene {SCENE} of sionna-rt at 6 GHz, depth {DEPTH}, one receiver behind a corner, {SNAPSHOTS} measurements,"
        f" {SUBCARRIERS} subcarriers of 30 kHz, half-wavelength arrays, isotropic vertical elements; one material for all"
        " objects, half-spaces of concrete in truth (permittivity 5.31, conductivity .139 S/m), 3 and .1 at the start."
    ),
    (
        f"Error: |P - P_true| / P_true, mean over {TESTS} receivers in the streets that calibration has not seen; lines"
        " are medians and bands quartiles over runs. The noise power is known to the schemes, the spread of phase errors"
        " is not."
    ),
)


class Truth(NamedTuple):
    """The calibration receiver as it is.

    Attributes:
        world: with the calibration receiver alone.
        rays: to it.
    """

    world: World
    rays: Rays

    def noise_power(self, ratio_db: float) -> float:
        """Of the noise per coefficient: the sum over paths of |a_p|^2 over the ratio."""
        return float(np.sum(np.abs(self.rays.gain) ** 2)) / 10 ** (ratio_db / 10)


class Twin(NamedTuple):
    """Paths to the calibration receiver and to the test receivers; materials unknown."""

    calibration: PathSet
    tests: PathSet


def world(side: int = SIDE) -> World:
    """The truth with square arrays of so many rows and columns."""
    array = planar_array(side, side, SPEED_OF_LIGHT / FREQUENCY / 2)
    ends = np.array([TRANSMITTER]), np.array([RECEIVER])
    return World(SCENE, FREQUENCY, *ends, array, array, materials=_concrete(), max_depth=DEPTH, rays=RAYS)


@functools.cache
def _concrete() -> Mapping[str, Material]:
    place, element = np.zeros((1, 3)), np.zeros((1, 3))
    return dict.fromkeys(scene_materials(World(SCENE, FREQUENCY, place, place, element, element)), TRUE)


@functools.cache
def scene() -> tuple[Truth, Twin]:
    """Truth and twin."""
    loaded = load_scene(SCENE, FREQUENCY)
    random = np.random.default_rng(1)
    streets = np.c_[random.uniform((-60, 20), (90, 120), (3 * TESTS, 2)), np.full(3 * TESTS, RECEIVER[2])]

    def paths(receivers: Float[np.ndarray, "link 3"], rays: int) -> PathSet:
        ends = np.tile(TRANSMITTER, (len(receivers), 1)), receivers
        return trace_twin(loaded, *ends, max_depth=DEPTH, samples=rays, frequency=FREQUENCY, allow_empty=True)

    tests = paths(streets, TEST_RAYS)
    reached = np.flatnonzero(np.asarray(tests.mask).any(axis=1))[:TESTS]
    place = world()
    return Truth(place, trace(place)), Twin(paths(np.array([RECEIVER]), RAYS), tests.take(reached))


def sounding() -> Sounding:
    """The subcarriers; measurements have no time."""
    return Sounding(subcarriers(SUBCARRIERS, SUBCARRIERS * SPACING), np.zeros(1))


def turned(
    truth: Truth, angles: Float[np.ndarray, "snapshot path"], side: int = SIDE
) -> Complex[np.ndarray, "snapshot entry"]:
    """Noiseless channels at the calibration receiver, whose paths are turned by these angles in rad."""
    each = path_channels(world(side), truth.rays, sounding())
    columns = each.reshape(angles.shape[1], -1).astype(np.complex64)
    return np.exp(1j * angles).astype(np.complex64) @ columns


def displaced(
    truth: Truth, displacement: Float[np.ndarray, "snapshot 3"]
) -> Complex[np.ndarray, "snapshot entry"]:
    """Noiseless channels at receivers displaced by these vectors in m, each traced afresh by Sionna RT."""
    place = dataclasses.replace(
        truth.world,
        tx_position=np.tile(truth.world.tx_position, (len(displacement), 1)),
        rx_position=truth.world.rx_position + displacement,
        rays=DISPLACED_RAYS,
    )
    rays = trace(place)
    turns = rays.delay[:, 0, :, None] * (FREQUENCY + sounding().subcarrier_frequency)
    tones = np.where(rays.mask, rays.gain[:, 0], 0)[..., None] * np.exp(-2j * np.pi * np.modf(turns)[0])
    return np.stack(
        [
            np.einsum("pa,pb,pk->abk", rx, tx, tone, optimize=True).astype(np.complex64).ravel()
            for rx, tx, tone in zip(*array_responses(place, rays), tones, strict=True)
        ]
    )


def generator(key: PRNGKeyArray, run: int) -> np.random.Generator:
    """Randomness of one run."""
    return np.random.default_rng([*np.asarray(jax.random.key_data(key)).tolist(), run])


def white(random: np.random.Generator, shape: tuple[int, int]) -> Complex[np.ndarray, "snapshot entry"]:
    """Circular normal noise of unit variance."""
    parts = random.standard_normal((2, *shape), np.float32)
    return (parts[0] + 1j * parts[1]) * np.float32(np.sqrt(0.5))


def statistics(twin: Twin, channel: Complex[np.ndarray, "snapshot entry"], side: int = SIDE) -> Statistics:
    """What calibration sees of the measured channels of one run."""
    array = planar_array(side, side, SPEED_OF_LIGHT / FREQUENCY / 2)
    shaped = channel.reshape(1, len(channel), len(array), len(array), SUBCARRIERS)
    frequency = jnp.asarray(sounding().subcarrier_frequency)
    return project(
        twin.calibration,
        frequency,
        jnp.asarray(shaped),
        rx_array=jnp.asarray(array),
        tx_array=jnp.asarray(array),
    )


def measured(
    key: PRNGKeyArray, run: int, concentration: float, ratio_db: float = SNR_DB, side: int = SIDE
) -> Statistics:
    """Statistics of one run's measurements, whose paths have von Mises errors of this concentration on their phases.

    Noise and the quantiles of the errors depend on the run alone: points of a curve differ by what the curve shows.
    """
    truth, twin = scene()
    random = generator(key, run)
    angles = von_mises(random.random((SNAPSHOTS, truth.rays.mask.shape[1])), concentration)
    channel = turned(truth, angles, side)
    channel += np.float32(np.sqrt(truth.noise_power(ratio_db))) * white(random, channel.shape)
    return statistics(twin, channel, side)


def calibrations(runs: Sequence[Statistics], ratio_db: float = SNR_DB) -> dict[Scheme, Calibration]:
    """Every scheme's calibration of every run."""
    truth, twin = scene()
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *runs)
    noise_power = jnp.full(len(runs), truth.noise_power(ratio_db))
    return {
        scheme: calibrate_runs(
            twin.calibration,
            stacked,
            noise_power,
            settings=Settings(scheme, concentration=1.0, law="half_space"),
        )
        for scheme in SCHEMES
    }


def errors(runs: Sequence[Statistics], ratio_db: float = SNR_DB) -> dict[str, Float[np.ndarray, " run"]]:
    """Relative error of the power sum_p |a_p|^2, mean over the test receivers, after each scheme, by run.

    The true power is that of the twin's paths with the true material, so that the material alone makes errors.
    """
    _, twin = scene()
    right = power(twin.tests, *true_materials(twin.tests))
    return {
        scheme: np.mean(np.abs(power(twin.tests, found.permittivity, found.conductivity) / right - 1), axis=1)
        for scheme, found in calibrations(runs, ratio_db).items()
    }


def true_materials(paths: PathSet) -> tuple[Float[jax.Array, "1 object"], Float[jax.Array, "1 object"]]:
    """Permittivity and conductivity of the truth, as of one run."""
    shape = 1, paths.n_object
    return jnp.full(shape, TRUE.permittivity), jnp.full(shape, TRUE.conductivity)


def power(
    paths: PathSet, permittivity: Float[jax.Array, "run object"], conductivity: Float[jax.Array, "run object"]
) -> Float[np.ndarray, "run link"]:
    """Sum over paths of |a_p|^2."""
    return np.asarray(_power(paths, permittivity, conductivity))


@jax.jit
def _power(paths: PathSet, permittivity: jax.Array, conductivity: jax.Array) -> jax.Array:
    def one(materials: tuple[jax.Array, jax.Array]) -> jax.Array:
        return jnp.sum(jnp.abs(path_gain(paths, *materials, law="half_space")) ** 2, axis=1)

    return jax.lax.map(one, (permittivity, conductivity))


def von_mises(probability: Float[np.ndarray, "*n"], concentration: float) -> Float[np.ndarray, "*n"]:
    """Quantiles of a von Mises distribution about zero, rad; an infinite concentration has no spread."""
    if np.isinf(concentration):
        return np.zeros_like(probability)
    grid = np.linspace(-np.pi, np.pi, 4097)
    density = np.exp(concentration * (np.cos(grid) - 1))
    steps = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2)])
    return np.interp(probability, steps / steps[-1], grid)
