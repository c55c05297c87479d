"""Two walls, one of them elsewhere than the twin believes: power error after calibration against the bandwidth.

A blocker hides the receiver from the transmitter, so two reflected paths arrive. One wall stands .4 wavelengths from where
the twin has it: its path has another phase and nearly the same strength. At small bandwidths the paths cannot be told
apart, and what a scheme believes of their phases decides what it makes of their powers.
"""

from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, PRNGKeyArray
from scipy.constants import epsilon_0

from dtprob.physical.channel import subcarriers
from dtprob.physical.world import SPEED_OF_LIGHT
from dtprob.raytracing.calibration import SCHEMES, Settings, Statistics, calibrate_runs, project
from dtprob.raytracing.field import path_gain
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.walls import between_walls
from dtprob.reproduce.calibration_urban import TRUE, generator, white
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress

RUNS: Final = 10
FREQUENCY: Final = 6e9
DISTANCE: Final = 24.0
WALLS: Final = (6.0, -9.0)
"""Where the walls stand beside the line from transmitter to receiver, m."""
SHIFT: Final = 0.4
"""Of the second wall against the twin, wavelengths."""
BANDWIDTHS: Final = (1e6, 5e6, 10e6, 25e6, 50e6, 100e6, 200e6, 500e6)
SUBCARRIERS: Final = 64
SNAPSHOTS: Final = 50
SNR_DB: Final = 20.0


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    each = [
        progress.part(f"{width / 1e6:g} MHz, {runs} runs", lambda width=width: _errors(key, runs, width))
        for width in BANDWIDTHS
    ]
    series = tuple(
        Series.of_runs(
            scheme, [width / 1e6 for width in BANDWIDTHS], np.stack([cell[scheme] for cell in each], axis=1)
        )
        for scheme in SCHEMES
    )
    x, y = Quantity("bandwidth", "MHz", is_log=True), Quantity("relative power error", is_log=True)
    notes = (
        (
            f"Walls at {WALLS[0]:g} and {WALLS[1]:g} m of a link of {DISTANCE:g} m, line of sight blocked; the second"
            f" stands {SHIFT:g} wavelengths further in truth. {SUBCARRIERS} subcarriers, single antennas, {SNAPSHOTS}"
            f" measurements at {SNR_DB:g} dB that differ by noise alone; concrete half-spaces, 3 and .1 S/m at the start."
        ),
        "Error: |P - P_true| / P_true at the receiver, P the sum of the two paths' powers. Positions of walls are chosen.",
    )
    title = "calibration with one wall misplaced"
    return Figure("fig5", title, (Panel(title, x, y, series),), runs, notes)


def _errors(key: PRNGKeyArray, runs: int, bandwidth: float) -> dict[str, Float[np.ndarray, " run"]]:
    twin = between_walls(DISTANCE, WALLS, FREQUENCY)
    grid = subcarriers(SUBCARRIERS, bandwidth)
    clean, power = _truth(grid)
    noise_power = power / 10 ** (SNR_DB / 10)
    found: list[Statistics] = []
    for number in range(runs):
        noise = white(generator(key, number), (SNAPSHOTS, SUBCARRIERS))
        measured = clean + np.sqrt(noise_power) * noise
        found.append(project(twin, jnp.asarray(grid), jnp.asarray(measured)[None, :, None, None]))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)
    errors: dict[str, np.ndarray] = {}
    for scheme in SCHEMES:
        settings = Settings(scheme, law="half_space")
        result = calibrate_runs(twin, stacked, jnp.full(runs, noise_power), settings=settings)
        powers = jax.vmap(lambda e, s: _power(twin, e, s))(result.permittivity, result.conductivity)
        errors[scheme] = np.abs(np.asarray(powers) / power - 1)
    return errors


def _power(paths: PathSet, permittivity: jax.Array, conductivity: jax.Array) -> jax.Array:
    return jnp.sum(jnp.abs(path_gain(paths, permittivity, conductivity, law="half_space")) ** 2)


def _truth(grid: Float[np.ndarray, " subcarrier"]) -> tuple[Complex[np.ndarray, " subcarrier"], float]:
    """The noiseless channel written out, by images and Fresnel's coefficient, and the sum of its paths' powers."""
    wavelength = SPEED_OF_LIGHT / FREQUENCY
    loss = TRUE.conductivity / (2 * np.pi * FREQUENCY * epsilon_0)
    total, power = np.zeros(len(grid), complex), 0.0
    for number, wall in enumerate(WALLS):
        offset = abs(wall) + (SHIFT * wavelength if number else 0.0)
        length = np.hypot(DISTANCE, 2 * offset)
        cosine = 2 * offset / length
        root = np.sqrt(TRUE.permittivity - 1j * loss - (1 - cosine**2))
        gain = wavelength / (4 * np.pi * length) * (cosine - root) / (cosine + root)
        total += gain * np.exp(-2j * np.pi * (FREQUENCY + grid) * length / SPEED_OF_LIGHT)
        power += abs(gain) ** 2
    return total, power
