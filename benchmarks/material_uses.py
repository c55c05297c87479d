"""What calibrated materials change for those who use a twin: places of receivers and beams, before and after.

    python benchmarks/material_uses.py [--snapshots 5] [--write]

Munich, 6 GHz, 4x4 antennas at both ends, 64 subcarriers of 30 kHz, 20 receivers in the streets. The real channels have
uniform phase errors and 0 dB of noise per coefficient. Before calibration the twin has permittivity 3 and .1 S/m
everywhere; after it, what `calibrate` found from one receiver behind a corner.
"""

import argparse
from typing import Any

import dtprob

dtprob.configure()  # before the first array

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from record import record  # noqa: E402

from dtprob.physical.world import SPEED_OF_LIGHT, planar_array  # noqa: E402
from dtprob.raytracing.calibration import Settings, Statistics, calibrate, project  # noqa: E402
from dtprob.raytracing.field import frequency_response, path_gain, steering, synthesize  # noqa: E402
from dtprob.raytracing.paths import PathSet  # noqa: E402
from dtprob.reproduce import calibration_urban as urban  # noqa: E402
from dtprob.twin.beamforming import gathered, statistical_beams  # noqa: E402
from dtprob.twin.localise import localise  # noqa: E402

SIDE = 4
SNR_DB = 0.0


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description="Places and beams before and after calibration.")
    parser.add_argument("--snapshots", type=int, default=5)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    paths, array = urban.scene()[1].tests, planar_array(SIDE, SIDE, SPEED_OF_LIGHT / urban.FREQUENCY / 2)
    true = gain(paths, urban.TRUE.permittivity, urban.TRUE.conductivity)
    real, noise_power = measured(paths, jnp.asarray(array), true, options.snapshots)
    statistics = against_all(paths, jnp.asarray(array), real)
    rows: list[dict[str, Any]] = [
        {
            "twin": name,
            **used(paths, jnp.asarray(array), gain(paths, *values), real, (statistics, noise_power)),
        }
        for name, values in twins().items()
    ]
    for row in rows:
        print(row)
    if options.write:
        write(rows)


def gain(paths: PathSet, permittivity: float, conductivity: float) -> jax.Array:
    """Gains of all paths for one material everywhere."""
    ones = jnp.ones(paths.n_object)
    return path_gain(paths, permittivity * ones, conductivity * ones, law="half_space")


def twins() -> dict[str, tuple[float, float]]:
    """Materials before and after calibration, and the true ones."""
    statistics = urban.measured(jax.random.key(0), 0, 0.0)
    noise_power = urban.scene()[0].noise_power(urban.SNR_DB)
    calibration = urban.scene()[1].calibration
    found = calibrate(calibration, statistics, noise_power, settings=Settings(law="half_space"))
    after = float(found.permittivity[0]), float(found.conductivity[0])
    return {"before": (3.0, 0.1), "after": after, "true": (urban.TRUE.permittivity, urban.TRUE.conductivity)}


def measured(paths: PathSet, array: jax.Array, true: jax.Array, snapshots: int) -> tuple[np.ndarray, float]:
    """Real channels (link, snapshot, rx, tx, subcarrier), and the power of their noise."""
    random = np.random.default_rng(0)
    angles = random.uniform(-np.pi, np.pi, (paths.n_link, snapshots, paths.n_path))
    clean = np.asarray(
        synthesize(
            true,
            frequency_response(paths, jnp.asarray(urban.sounding().subcarrier_frequency)),
            steering(array, paths.arrival, paths.frequency, -1.0),
            steering(array, paths.departure, paths.frequency, 1.0),
            jnp.exp(1j * jnp.asarray(angles)),
        )
    )
    # as loud as the weakest receiver
    noise_power = float(jnp.min(jnp.sum(jnp.abs(true) ** 2, axis=1))) / 10 ** (SNR_DB / 10)
    parts = random.standard_normal((2, *clean.shape))
    return clean + np.sqrt(noise_power / 2) * (parts[0] + 1j * parts[1]), noise_power


def against_all(paths: PathSet, array: jax.Array, real: np.ndarray) -> Statistics:
    """Statistics of every measurement against the paths of every candidate."""
    every = jnp.asarray(real.reshape(1, -1, *real.shape[2:]))
    tones = jnp.asarray(urban.sounding().subcarrier_frequency)
    found = [
        project(paths.take(np.array([place])), tones, every, rx_array=array, tx_array=array, powers=False)
        for place in range(paths.n_link)
    ]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *found)


def used(
    paths: PathSet,
    array: jax.Array,
    believed: jax.Array,
    real: np.ndarray,
    statistics: tuple[Statistics, float],
) -> dict[str, float]:
    """How often the right place is found, how sure of it, and what the twin's beams gather."""
    found = localise(statistics[0], believed, statistics[1])
    right = np.repeat(np.arange(paths.n_link), real.shape[1])
    probability = np.asarray(found.probability)[np.arange(len(right)), right]
    share = gathered(statistical_beams(paths, believed, array, array), jnp.asarray(real))
    return {
        "right_place": round(float(np.mean(np.asarray(found.candidate) == right)), 4),
        "log_probability_of_the_right_place": round(
            float(np.mean(np.log(np.maximum(probability, 1e-300)))), 4
        ),
        "beam_share": round(float(jnp.mean(share)), 4),
        "worst_beam_share": round(float(jnp.min(jnp.mean(share, axis=1))), 4),
    }


def write(rows: list[dict[str, Any]]) -> None:
    """Keep the table."""
    what = "places among 20 and beams of 4x4 antennas, before and after calibrating the material"
    record("material_uses", what, ("jax", "sionna-rt"), {"rows": rows})


if __name__ == "__main__":
    main()
