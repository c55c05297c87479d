"""Coverage map of the calibrated twin: how much of the covered area has its power right, with and without phase errors."""

import functools
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from dtprob.raytracing.calibration import SCHEMES
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.sionna import sionna_rt
from dtprob.raytracing.trace import load_scene, trace
from dtprob.reproduce import calibration_urban as urban
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress

RUNS: Final = 10
EXTENT: Final = 600.0
"""Side of the square around the transmitter, m."""
CELL: Final = 5.0
HEIGHT: Final = 1.0
DEPTH: Final = 5
RAYS: Final = 200_000
SEARCH_RAYS: Final = 10_000_000
"""Of the solver of maps, which tells what cells rays cross at all."""
REGIMES: Final[Mapping[str, float]] = {"exact phases": np.inf, "uniform phases": 0.0}
"""Concentration of the phase errors in the calibration data."""
_LEVELS_DB: Final = np.linspace(-30.0, 0.0, 31)
_TARGET_DB: Final = -10.0


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    shares = {
        name: progress.part(f"{name}, {runs} runs", functools.partial(_shares, key, runs, k))
        for name, k in REGIMES.items()
    }
    x = Quantity("relative power error", "dB")
    panels = tuple(
        Panel(
            f"calibrated with {name}",
            x,
            Quantity("share of covered cells below"),
            tuple(Series.of_runs(scheme, _LEVELS_DB, found[scheme]) for scheme in SCHEMES),
        )
        for name, found in shares.items()
    )
    notes = (*urban.NOTES[:1], _choices(next(iter(shares.values()))), *_targets(shares))
    return Figure("fig7", "coverage map of the calibrated twin", panels, runs, notes)


def cells() -> Float[np.ndarray, "cell 3"]:
    """Centres of the cells of the map."""
    axis = np.arange(-EXTENT / 2 + CELL / 2, EXTENT / 2, CELL)
    x, y = np.meshgrid(urban.TRANSMITTER[0] + axis, urban.TRANSMITTER[1] + axis)
    return np.c_[x.ravel(), y.ravel(), np.full(x.size, HEIGHT)]


@functools.cache
def covered() -> PathSet:
    """Paths to the cells that have any."""
    scene = load_scene(urban.SCENE, urban.FREQUENCY)
    places = cells()[crossed(scene)]
    paths = trace(
        scene,
        np.tile(urban.TRANSMITTER, (len(places), 1)),
        places,
        max_depth=DEPTH,
        samples=RAYS,
        frequency=urban.FREQUENCY,
        allow_empty=True,
    )
    return paths.take(np.asarray(paths.mask).any(axis=1))


def crossed(scene: Any) -> Bool[np.ndarray, " cell"]:
    """Which cells any ray crosses: only there can a path end, and most of the map lies inside of blocks."""
    rt = sionna_rt()
    import mitsuba as mi  # noqa: PLC0415

    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Transmitter("map", mi.Point3f(*urban.TRANSMITTER)))
    found = rt.RadioMapSolver()(
        scene,
        center=mi.Point3f(*urban.TRANSMITTER[:2], HEIGHT),
        orientation=mi.Point3f(0, 0, 0),
        size=mi.Point2f(EXTENT, EXTENT),
        cell_size=mi.Point2f(CELL, CELL),
        samples_per_tx=SEARCH_RAYS,
        max_depth=DEPTH,
        refraction=False,
        seed=1,
    )
    scene.remove("map")
    return np.asarray(found.path_gain)[0].ravel() > 0


def _shares(key: PRNGKeyArray, runs: int, concentration: float) -> dict[str, Float[np.ndarray, "run level"]]:
    """Share of covered cells whose error is below each level, by scheme; and how many cells there are."""
    paths = covered()
    truth = urban.power(paths, *urban.true_materials(paths))
    measured = [urban.measured(key, run, concentration) for run in range(runs)]
    found: dict[str, np.ndarray] = {"cells": np.array([[paths.n_link]])}
    for scheme, result in urban.calibrations(measured).items():
        error = np.abs(urban.power(paths, result.permittivity, result.conductivity) / truth - 1)
        level = 10 * np.log10(np.maximum(error, 1e-12))
        found[scheme] = np.mean(level[..., None] < _LEVELS_DB, axis=1)
    return found


def _choices(found: Mapping[str, np.ndarray]) -> str:
    count = int(found["cells"].item())
    return (
        f"{EXTENT:g} x {EXTENT:g} m in cells of {CELL:g} m at a height of {HEIGHT:g} m, depth {DEPTH}; {count} of"
        f" {len(cells())} cells have a path, found among those that any of {SEARCH_RAYS} rays crosses. The map is"
        " that of one material; the error is the material's alone."
    )


def _targets(shares: Mapping[str, Mapping[str, np.ndarray]]) -> tuple[str, ...]:
    """For each regime, the share of cells below the target."""
    at = int(np.argmin(np.abs(_LEVELS_DB - _TARGET_DB)))
    return tuple(
        f"{name}: share of covered cells with an error below {_TARGET_DB:g} dB, median over runs: "
        + ", ".join(f"{scheme} {np.median(found[scheme][:, at]):.3f}" for scheme in SCHEMES)
        for name, found in shares.items()
    )
