"""A whole phase-aware calibration: its time, what a step costs as arrays and bands grow, and memory of many links.

    python benchmarks/bench_calibration.py [--rounds 5] [--links 10000] [--write]

The measurement is that of figure 6b: munich, one receiver behind a corner, 50 snapshots, 64 subcarriers, 8x8 antennas at
both ends. `calibrate` runs 900 steps on its statistics, which are computed once; the time of that is told too. Times are
of the processor, medians over rounds taken in turn, after compiling. For memory, value and gradient of mean |H|^2 of many
links at once are computed in a process of their own.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
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
from dtprob.reproduce import calibration_urban as urban  # noqa: E402

SIZES = ((1, 64), (4, 64), (8, 64), (8, 256))
"""Rows and columns of the arrays, and subcarriers."""
STEPS = 900


def main() -> None:
    """Run the benchmark and print its figures."""
    options = arguments()
    if options.memory_only:
        print(json.dumps(memory(options.links)))
        return
    steps: dict[str, Callable[[], Any]] = {}
    for side, tones in SIZES:
        name = f"{side}x{side} antennas, {tones} subcarriers"
        steps[name] = calibration(*measurement(side, tones))
    steps["statistics"] = lambda: projected(8, 64)
    seconds = in_turns(steps, options.rounds)
    for name, value in seconds.items():
        print(f"{name:34s} {value:8.3f} s")
    child = subprocess.run(
        [sys.executable, __file__, "--memory-only", "--links", str(options.links)],
        check=True,
        capture_output=True,
        text=True,
    )
    found = json.loads(child.stdout)
    print(found)
    if options.write:
        write(seconds, found)


def arguments() -> argparse.Namespace:
    """Rounds and links."""
    parser = argparse.ArgumentParser(description="A whole calibration.")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--links", type=int, default=10_000)
    parser.add_argument("--memory-only", action="store_true")
    parser.add_argument("--write", action="store_true")
    return parser.parse_args()


def channel(side: int, tones: int) -> np.ndarray:
    """Measured channels with uniform phase errors, on the twin's own paths."""
    paths = urban.scene()[1].calibration
    array = jnp.asarray(planar_array(side, side, SPEED_OF_LIGHT / urban.FREQUENCY / 2))
    random = np.random.default_rng(0)
    angles = random.uniform(-np.pi, np.pi, (1, urban.SNAPSHOTS, paths.n_path))
    gain = path_gain(paths, *(value[0] for value in urban.true_materials(paths)), law="half_space")
    clean = synthesize(
        gain,
        frequency_response(paths, grid(tones)),
        steering(array, paths.arrival, paths.frequency, -1.0),
        steering(array, paths.departure, paths.frequency, 1.0),
        jnp.exp(1j * jnp.asarray(angles)),
    ).astype(jnp.complex64)
    noise = urban.white(random, (urban.SNAPSHOTS, int(np.prod(clean.shape[2:]))))
    return np.asarray(clean) + np.float32(np.sqrt(level())) * noise.reshape(clean.shape)


def level() -> float:
    """Power of the noise at 20 dB."""
    return urban.scene()[0].noise_power(urban.SNR_DB)


def grid(tones: int) -> jax.Array:
    """Subcarriers, 30 kHz apart."""
    return jnp.asarray((np.arange(tones) - (tones - 1) / 2) * urban.SPACING)


KEPT: dict[tuple[int, int], np.ndarray] = {}


def projected(side: int, tones: int) -> Statistics:
    """Statistics of the measurement."""
    if (side, tones) not in KEPT:
        KEPT[side, tones] = channel(side, tones)
    array = jnp.asarray(planar_array(side, side, SPEED_OF_LIGHT / urban.FREQUENCY / 2))
    paths = urban.scene()[1].calibration
    found = project(
        paths, grid(tones), jnp.asarray(KEPT[side, tones]), rx_array=array, tx_array=array, powers=False
    )
    return jax.block_until_ready(found)


def measurement(side: int, tones: int) -> tuple[Statistics, float]:
    """Statistics of the measurement and the power of its noise."""
    return projected(side, tones), level()


def calibration(statistics: Statistics, noise_power: float) -> Callable[[], Any]:
    """A calibration of all steps."""
    paths = urban.scene()[1].calibration
    settings = Settings(iterations=STEPS, concentration=1.0, law="half_space")
    return lambda: jax.block_until_ready(calibrate(paths, statistics, noise_power, settings=settings))


def in_turns(steps: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Median seconds of the processor for each step, taken in turn."""
    times: dict[str, list[float]] = {name: [] for name in steps}
    for step in steps.values():
        step()
    for _ in range(rounds):
        for name, step in steps.items():
            begin = time.process_time()
            step()
            times[name].append(time.process_time() - begin)
    return {name: float(np.median(values)) for name, values in times.items()}


def memory(links: int) -> dict[str, Any]:
    """Peak memory of value and gradient of many links in one call."""
    tests = urban.scene()[1].tests
    paths = tests.take(np.arange(links) % tests.n_link)
    bytes_per_link = sum(leaf.nbytes for leaf in jax.tree.leaves(paths)) / links

    def loss(permittivity: jax.Array, paths: Any) -> jax.Array:
        gain = path_gain(paths, permittivity, 0.1 * jnp.ones(paths.n_object), law="half_space")
        return jnp.mean(jnp.abs(synthesize(gain, frequency_response(paths, grid(64)))) ** 2)

    value = jax.block_until_ready(jax.jit(jax.value_and_grad(loss))(jnp.full(paths.n_object, 5.0), paths))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if not np.isfinite(float(value[0])):
        sys.exit("the value is not finite")
    return {
        "links": links,
        "paths_per_link": paths.n_path,
        "depth": paths.depth,
        "path_set_kb_per_link": round(bytes_per_link / 1e3, 2),
        "peak_gb_of_the_process_with_tracing": round(peak / 1e6, 2),
    }


def write(seconds: dict[str, float], found: dict[str, Any]) -> None:
    """Keep the figures."""
    what = f"phase-aware calibration, {STEPS} steps, 50 snapshots, processor time after compiling"
    figures = {"seconds": {name: round(value, 3) for name, value in seconds.items()}, "memory": found}
    record("calibration_of_materials", what, ("jax", "optax"), figures)


if __name__ == "__main__":
    main()
