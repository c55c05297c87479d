"""Power error after calibration against a displacement of the receiver that the twin does not know of."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from dtprob.physical.world import SPEED_OF_LIGHT
from dtprob.raytracing.calibration import SCHEMES
from dtprob.reproduce import calibration_urban as urban
from dtprob.reproduce.fig6b import ERROR
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress

RUNS: Final = 10
DISPLACEMENTS: Final = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
"""In wavelengths."""


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    return figure(key, runs, progress, DISPLACEMENTS)


def figure(key: PRNGKeyArray, runs: int, progress: Progress, displacements: Sequence[float]) -> Figure:
    """The figure for some displacements, in wavelengths."""
    each = [
        progress.part(
            f"displacement {size:g} wavelengths, {runs} runs", lambda size=size: _cell(key, runs, size)
        )
        for size in displacements
    ]
    series = [
        Series.of_runs(scheme, list(displacements), np.stack([errors[scheme] for errors in each], axis=1))
        for scheme in SCHEMES
    ]
    x = Quantity("displacement of the receiver", "wavelengths")
    title = "calibration with a displaced receiver"
    notes = (
        *urban.NOTES,
        (
            "Every measurement has a displacement of its own, in a random direction in space, and is traced afresh by"
            f" Sionna RT, {urban.DISPLACED_RAYS} rays; the twin's paths are those of the place it believes in."
        ),
    )
    return Figure("fig6a", title, (Panel(title, x, ERROR, tuple(series)),), runs, notes)


def _cell(key: PRNGKeyArray, runs: int, wavelengths: float) -> dict[str, Float[np.ndarray, " run"]]:
    truth, twin = urban.scene()
    size = wavelengths * SPEED_OF_LIGHT / urban.FREQUENCY
    found = []
    for number in range(runs):
        random = urban.generator(key, number)
        direction = random.standard_normal((urban.SNAPSHOTS, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        channel = urban.displaced(truth, size * direction)
        channel += np.float32(np.sqrt(truth.noise_power(urban.SNR_DB))) * urban.white(random, channel.shape)
        found.append(urban.statistics(twin, channel))
    return urban.errors(found)
