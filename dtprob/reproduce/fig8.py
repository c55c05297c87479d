"""Power-delay profile of a receiver that took no part in the calibration, against a simulation of the wave.

The truth is the field of `dtprob.reproduce.fig8_scene`. The twin's lower wall stands a quarter of a wavelength
from where it should. Channels to two receivers, with noise, calibrate the walls' material; the profile at the
third is foreseen. How far a profile is off is its squared difference to the simulated one over that one's
square, both summed over delays.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from dtprob.physical.wave import CONCRETE
from dtprob.raytracing.calibration import Calibration, Scheme, Settings, calibrate_runs, project
from dtprob.raytracing.paths import PathSet
from dtprob.reproduce.fig8_scene import BANDWIDTHS, Simulated, read_simulated, subcarrier_frequency
from dtprob.reproduce.fig8_twin import Materials, expected_profile, profile, ray_channel, trace_scene
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress

RUNS: Final = 10
SCHEMES: Final[tuple[Scheme, ...]] = ("aware", "oblivious", "uniform")
SNAPSHOTS: Final = 50
SNR: Final = 100.0
START: Final = Materials(3.0, 0.1)
_CALIBRATING: Final = np.array([0, 1])
_TESTED: Final = 2
_SHOWN: Final = (10e-9, 55e-9)
"""Delays in s: of the first path and a little after the last one that the twin has."""
_WEAKEST: Final = -40.0


class Outcome(NamedTuple):
    """Of one scheme at one bandwidth.

    Attributes:
        profile: over the sum of the simulated one.
        error: see the module.
        permittivity, conductivity: that were found; S/m.
        concentration: of phase errors, found or assumed.
    """

    profile: Float[np.ndarray, "run delay"]
    error: Float[np.ndarray, " run"]
    permittivity: Float[np.ndarray, " run"]
    conductivity: Float[np.ndarray, " run"]
    concentration: Float[np.ndarray, " run"]


class Band(NamedTuple):
    """Of one bandwidth.

    Attributes:
        delay: s.
        measured: simulated profile, of sum 1.
        outcomes: by scheme.
    """

    delay: Float[np.ndarray, " delay"]
    measured: Float[np.ndarray, " delay"]
    outcomes: Mapping[Scheme, Outcome]


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    simulated = read_simulated()
    bands = {width: band(key, runs, simulated, width, progress) for width in BANDWIDTHS}
    panels = [_profiles(width, found) for width, found in bands.items()]
    notes = [*_geometry_notes(simulated), *(note for item in bands.items() for note in _notes(*item))]
    title = "power-delay profile of the third receiver, against a wave simulation"
    return Figure("fig8", title, (*panels, _errors(bands)), runs, tuple(notes))


def band(key: PRNGKeyArray, runs: int, simulated: Simulated, bandwidth: float, progress: Progress) -> Band:
    """Calibrate with every scheme at one bandwidth and foresee the third receiver's profile.

    Args:
        key: typed JAX key.
        runs: draws of the noise.
        simulated: the truth.
        bandwidth: one of `BANDWIDTHS`.
        progress: of the figure.
    """
    frequency = subcarrier_frequency(bandwidth)
    truth = simulated.channel[:, BANDWIDTHS.index(bandwidth)]
    delay, measured = profile(truth[_TESTED], frequency)
    total = measured.sum()

    def outcome(scheme: Scheme) -> Outcome:
        name = f"{bandwidth / 1e6:g} MHz, {scheme}"
        return Outcome(**progress.part(name, lambda: _outcome(key, runs, truth, frequency, scheme)._asdict()))

    return Band(delay, measured / total, {scheme: outcome(scheme) for scheme in SCHEMES})


def _outcome(
    key: PRNGKeyArray, runs: int, truth: np.ndarray, frequency: np.ndarray, scheme: Scheme
) -> Outcome:
    paths = trace_scene(START)
    calibrating = paths.take(_CALIBRATING)
    noise_power = float(np.mean(np.abs(truth[_CALIBRATING]) ** 2) / SNR)
    noise = _noise(key, (runs, len(_CALIBRATING), SNAPSHOTS, 1, 1, len(frequency)), noise_power)
    channel = truth[_CALIBRATING][:, None, None, None] + noise
    statistics = [project(calibrating, jnp.asarray(frequency), jnp.asarray(one)) for one in channel]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *statistics)
    settings = Settings(
        scheme, permittivity=START.permittivity, conductivity=START.conductivity, concentration=1.0
    )
    found = calibrate_runs(calibrating, together, jnp.full(runs, noise_power), settings=settings)
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], found) for i in range(runs)]
    measured = profile(truth[_TESTED], frequency)[1]
    profiles = np.stack([_foreseen(one, frequency) for one in each]) / measured.sum()
    difference = profiles - measured / measured.sum()
    error = np.sum(difference**2, axis=1) / np.sum((measured / measured.sum()) ** 2)
    permittivity, conductivity = (
        np.asarray(value[:, 0]) for value in (found.permittivity, found.conductivity)
    )
    return Outcome(profiles, error, permittivity, conductivity, np.asarray(found.concentration))


def _foreseen(found: Calibration, frequency: np.ndarray) -> Float[np.ndarray, " delay"]:
    return expected_profile(trace_scene(START), found, frequency, _TESTED)[1]


def _noise(key: PRNGKeyArray, shape: tuple[int, ...], power: float) -> np.ndarray:
    parts = jax.random.normal(key, (2, *shape), float) * np.sqrt(power / 2)
    return np.asarray(parts[0] + 1j * parts[1])


def _profiles(bandwidth: float, found: Band) -> Panel:
    shown = (found.delay >= _SHOWN[0]) & (found.delay <= _SHOWN[1])

    def curve(name: str, values: Float[np.ndarray, "run delay"]) -> Series:
        level = 10 * np.log10(values[:, shown])
        return Series.of_runs(name, 1e9 * found.delay[shown], np.where(level < _WEAKEST, np.nan, level))

    series = [curve(scheme, found.outcomes[scheme].profile) for scheme in SCHEMES]
    axes = Quantity("delay", "ns"), Quantity("power over the measured sum", "dB")
    return Panel(f"{bandwidth / 1e6:g} MHz", *axes, (*series, curve("measured", found.measured[None])))


def _errors(bands: Mapping[float, Band]) -> Panel:
    widths = [width / 1e6 for width in bands]
    series = [
        Series.of_runs(
            scheme, widths, np.stack([found.outcomes[scheme].error for found in bands.values()], 1)
        )
        for scheme in SCHEMES
    ]
    axes = Quantity("bandwidth", "MHz", is_log=True), Quantity("squared error of the profile", is_log=True)
    return Panel("error", *axes, tuple(series))


def _notes(bandwidth: float, found: Band) -> list[str]:
    return [
        f"{bandwidth / 1e6:g} MHz, {scheme}: squared error of the profile {np.median(one.error):.4f}, "
        f"its sum {10 * np.log10(np.median(one.profile.sum(axis=1))):+.2f} dB, "
        f"material {np.median(one.permittivity):.2f} and {np.median(one.conductivity):.3g} S/m, "
        f"concentration {np.median(one.concentration):.3g}"
        for scheme, one in found.outcomes.items()
    ]


def _geometry_notes(simulated: Simulated) -> list[str]:
    """How far rays are from the wave, with the walls where they are and with the twin's."""
    true = Materials(*CONCRETE)
    rows = {"true geometry": trace_scene(true, 0.0), "shifted wall": trace_scene(true)}
    grid = f"wave simulated with {simulated.cells:g} cells per wavelength, {simulated.tail:.2g} of the field left"
    concrete = f"true material: {true.permittivity} and {true.conductivity:.3g} S/m"
    return [f"{grid}; {concrete}"] + [
        f"{width / 1e6:g} MHz: normalised squared error of rays with true materials: "
        + ", ".join(f"{name} {residual(simulated, paths, width):.4f}" for name, paths in rows.items())
        for width in BANDWIDTHS
    ]


def residual(simulated: Simulated, paths: PathSet, bandwidth: float) -> float:
    """Squared difference of the rays' channel to the simulated one, over that one's square."""
    truth = simulated.channel[:, BANDWIDTHS.index(bandwidth)]
    rays = ray_channel(paths, subcarrier_frequency(bandwidth))
    return float(np.sum(np.abs(rays - truth) ** 2) / np.sum(np.abs(truth) ** 2))
