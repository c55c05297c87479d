"""Value and gradient of mean |H - y|^2 in the materials: stored paths in JAX against tracing again.

    python benchmarks/bench_field.py [--links 50] [--subcarriers 64] [--samples 100000] [--write]

The rival is Sionna RT: it solves for the paths at every step and differentiates through them with Dr.Jit
(evaluated loops). Both run in turn in one process, and the figure is the ratio of their median times.
--write keeps it in benchmarks/results/field.json.
"""

import argparse
import datetime as dt
import json
import platform
import shlex
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.raytracing.field import frequency_response, path_gain, synthesize
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.sionna import sionna_rt
from dtprob.raytracing.sionna_patch import repaired_sionna
from dtprob.raytracing.trace import load_scene, trace

CARRIER, SPACING, SCALE = 3.5e9, 30e3, 1e10
REPEATS = {"jax": 50, "sionna_rt": 1}


def main() -> None:
    """Run the benchmark and print its figure."""
    options = arguments()
    scene = load_scene("munich", CARRIER)
    tx, rx = places(options.links)
    paths = trace(scene, tx, rx, samples=options.samples, allow_empty=True)
    offset = SPACING * (np.arange(options.subcarriers) - options.subcarriers // 2)
    target = np.asarray(channel(paths, offset, 1.1 * paths.permittivity, 1.2 * paths.conductivity))
    ours = stored(paths, offset, target)
    theirs = traced_again(scene, paths, offset, target, options.samples)
    compare(ours(), theirs())
    times = in_turns({"jax": ours, "sionna_rt": theirs}, options.rounds)
    ratio = times["sionna_rt"] / times["jax"]
    for name, value in times.items():
        print(f"{name:10s} {1e3 * value:10.3f} ms")
    print(f"ratio      {ratio:10.0f}")
    if options.write:
        write(options, paths, times, ratio)


def arguments() -> argparse.Namespace:
    """Size of the problem and number of rounds."""
    parser = argparse.ArgumentParser(description="Field of stored paths against tracing again.")
    for name, default in (("links", 50), ("subcarriers", 64), ("samples", 100_000), ("rounds", 11)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--write", action="store_true")
    return parser.parse_args()


def places(links: int) -> tuple[np.ndarray, np.ndarray]:
    """A base station above the roofs and receivers in the streets around it."""
    random = np.random.default_rng(0)
    rx = np.c_[random.uniform(-50, 90, links), random.uniform(20, 120, links), np.full(links, 1.5)]
    return np.repeat([[8.5, 21.0, 27.0]], links, axis=0), rx


def channel(
    paths: PathSet, offset: np.ndarray, permittivity: jax.Array, conductivity: jax.Array
) -> jax.Array:
    """H over links and subcarriers."""
    gain = path_gain(paths, permittivity, conductivity)
    return synthesize(gain, frequency_response(paths, jnp.asarray(offset)))[:, 0, 0, 0]


def stored(paths: PathSet, offset: np.ndarray, target: np.ndarray) -> Callable[[], tuple[float, np.ndarray]]:
    """Value and gradient in permittivity and conductivity of each material, from stored paths."""

    def loss(materials: tuple[jax.Array, jax.Array], paths: PathSet, target: jax.Array) -> jax.Array:
        each = [value[paths.object_material] for value in materials]
        return SCALE * jnp.mean(jnp.abs(channel(paths, offset, *each) - target) ** 2)

    first = [int(np.argmax(np.asarray(paths.object_material) == i)) for i in range(paths.n_material)]
    materials = (paths.permittivity[np.array(first)], paths.conductivity[np.array(first)])
    function = jax.jit(jax.value_and_grad(loss))

    def step() -> tuple[float, np.ndarray]:
        value, gradient = jax.block_until_ready(function(materials, paths, jnp.asarray(target)))
        return float(value), np.asarray(gradient)

    return step


def traced_again(
    scene: Any, paths: PathSet, offset: np.ndarray, target: np.ndarray, samples: int
) -> Callable[[], tuple[float, np.ndarray]]:
    """The same, by Sionna's path solver at every step and Dr.Jit's derivatives."""
    import drjit as dr  # noqa: PLC0415
    import mitsuba as mi  # noqa: PLC0415

    rt = sionna_rt()
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Transmitter("tx", np.asarray(paths.tx_position[0]).tolist()))
    for number, place in enumerate(np.asarray(paths.rx_position).tolist()):
        scene.add(rt.Receiver(f"rx-{number}", place))
    solver = rt.PathSolver(deterministic=True)
    solver.loop_mode = "evaluated"
    materials = [scene.radio_materials[name] for name in paths.material_names]
    start = [[float(np.asarray(v)[0]) for v in (m.relative_permittivity, m.conductivity)] for m in materials]
    y = [mi.TensorXf(np.ascontiguousarray(part, np.float32)) for part in (target.real, target.imag)]

    def step() -> tuple[float, np.ndarray]:
        values = [[dr.opaque(mi.Float, value) for value in pair] for pair in start]
        for material, (permittivity, conductivity) in zip(materials, values, strict=True):
            dr.enable_grad(permittivity, conductivity)
            material.relative_permittivity, material.conductivity = permittivity, conductivity
        with repaired_sionna():
            found = solver(scene, max_depth=3, samples_per_src=samples, refraction=False, seed=1)
            real, imaginary = found.cfr(mi.Float(offset), normalize_delays=False, out_type="drjit")
        shape = (len(target), len(offset))
        error = [
            dr.reshape(mi.TensorXf, h, shape) - part for h, part in zip((real, imaginary), y, strict=True)
        ]
        loss = SCALE * dr.mean(dr.square(error[0]) + dr.square(error[1]))
        dr.backward(loss)
        slopes = [[float(np.asarray(dr.grad(value))[0]) for value in pair] for pair in values]
        return float(np.asarray(loss).reshape(-1)[0]), np.asarray(slopes).T

    return step


def compare(ours: tuple[float, np.ndarray], theirs: tuple[float, np.ndarray]) -> None:
    """Say how far the two answers are apart; the rival keeps phases in single precision."""
    gradient = np.max(np.abs(ours[1] - theirs[1])) / np.max(np.abs(ours[1]))
    print(f"value {ours[0]:.6g} and {theirs[0]:.6g}; gradients differ by {gradient:.1e} of the largest")
    if abs(ours[0] / theirs[0] - 1) > 0.02 or gradient > 0.05:
        sys.exit("the two do not compute the same thing")


def in_turns(steps: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Median seconds of each step, taken in turn so that a busy machine slows both alike.

    A step is repeated in its turn, after one that does not count: a fit runs it many times in a row.
    """
    times: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(rounds):
        for name, step in steps.items():
            step()
            for _ in range(REPEATS[name]):
                begin = time.perf_counter()
                step()
                times[name].append(time.perf_counter() - begin)
    return {name: float(np.median(values)) for name, values in times.items()}


def write(options: argparse.Namespace, paths: PathSet, times: dict[str, float], ratio: float) -> None:
    """Keep the figure with what it takes to repeat it."""
    command = shlex.join(["python", "benchmarks/bench_field.py", *sys.argv[1:]])
    result = {
        "benchmark": "value and gradient of mean |H - y|^2 in the materials, munich, depth 3",
        "command": command,
        "date": dt.datetime.now(dt.UTC).date().isoformat(),
        "machine": f"{platform.machine()}, 2 shared CPU cores, no GPU",
        "versions": {name: version(name) for name in ("jax", "sionna-rt", "drjit")},
        "size": {"links": options.links, "subcarriers": options.subcarriers, "paths": int(paths.mask.sum())},
        "rays": options.samples,
        "milliseconds": {name: round(1e3 * value, 3) for name, value in times.items()},
        "ratio": round(ratio),
    }
    file = Path(__file__).parent / "results" / "field.json"
    file.parent.mkdir(exist_ok=True)
    file.write_text(json.dumps(result, indent=2) + "\n")
    print(f"written to {file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file}")


if __name__ == "__main__":
    main()
