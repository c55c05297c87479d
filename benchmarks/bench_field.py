"""Value and gradient of mean |H - y|^2 in the materials: stored paths in JAX, in Dr.Jit, and tracing again.

    python benchmarks/bench_field.py [--links 50] [--side 8] [--subcarriers 64] [--samples 100000] [--write]

The rivals: Sionna RT, which solves for the paths at every step and differentiates through them with Dr.Jit (evaluated
loops); the same without its search for paths, which it has no public way to leave out; and Dr.Jit on the stored paths
with the formulas that JAX has, its program built at every step or frozen. Channels between arrays of side x side
antennas enter all of them through the same statistics. All run in turn in one process, and the figures are ratios of
median times. --write keeps them in benchmarks/results/field.json.
"""

import argparse
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from record import record
from rival_drjit import libraries, mean_square, stored_in_drjit

from dtprob.physical.world import SPEED_OF_LIGHT, planar_array
from dtprob.raytracing.calibration import Statistics, project
from dtprob.raytracing.candidates import large_table
from dtprob.raytracing.field import frequency_response, path_gain, steering, synthesize
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.sionna import sionna_rt
from dtprob.raytracing.sionna_patch import repaired_sionna
from dtprob.raytracing.trace import load_scene, trace

CARRIER, SPACING, SCALE = 3.5e9, 30e3, 1e10
SAME_DELAY = 1e-11
"""Of two paths that are one, s."""
REPEATS = {"jax": 50, "drjit": 3, "drjit_frozen": 3, "sionna_kept": 3, "sionna_rt": 1}


def main() -> None:
    """Run the benchmark and print its figure."""
    options = arguments()
    scene = load_scene("munich", CARRIER)
    tx, rx = places(options.links)
    paths = trace(scene, tx, rx, samples=options.samples, allow_empty=True)
    statistics = measured(paths, options.subcarriers, options.side)
    start = scene_materials(paths)
    steps = {
        "jax": stored(paths, statistics, start),
        "drjit_frozen": stored_in_drjit(paths, statistics, start, SCALE, frozen=True),
        "drjit": stored_in_drjit(paths, statistics, start, SCALE, frozen=False),
        "sionna_kept": traced_again(scene, paths, statistics, start, options.samples, keep=True),
        "sionna_rt": traced_again(scene, paths, statistics, start, options.samples, keep=False),
    }
    for name, step in steps.items():
        compare(name, steps["jax"](), step())
    times = in_turns(steps, options.rounds)
    ratios = {name: value / times["jax"] for name, value in times.items() if name != "jax"}
    for name, value in times.items():
        print(f"{name:14s} {1e3 * value:10.3f} ms   {ratios.get(name, 1):8.1f}")
    if options.write:
        write(options, paths, times, ratios)


def arguments() -> argparse.Namespace:
    """Size of the problem and number of rounds."""
    parser = argparse.ArgumentParser(description="Field of stored paths against tracing again.")
    for name, default in (
        ("links", 50),
        ("side", 8),
        ("subcarriers", 64),
        ("samples", 100_000),
        ("rounds", 11),
    ):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--write", action="store_true")
    return parser.parse_args()


def places(links: int) -> tuple[np.ndarray, np.ndarray]:
    """A base station above the roofs and receivers in the streets around it."""
    random = np.random.default_rng(0)
    rx = np.c_[random.uniform(-50, 90, links), random.uniform(20, 120, links), np.full(links, 1.5)]
    return np.repeat([[8.5, 21.0, 27.0]], links, axis=0), rx


def measured(paths: PathSet, subcarriers: int, side: int) -> Statistics:
    """Statistics of noiseless channels of other materials, between square arrays of so many rows."""
    offset = jnp.asarray(SPACING * (np.arange(subcarriers) - subcarriers // 2))
    array = jnp.asarray(planar_array(side, side, SPEED_OF_LIGHT / CARRIER / 2))
    true = synthesize(
        path_gain(paths, 1.1 * paths.permittivity, 1.2 * paths.conductivity),
        frequency_response(paths, offset),
        steering(array, paths.arrival, paths.frequency, -1.0),
        steering(array, paths.departure, paths.frequency, 1.0),
    )
    return project(paths, offset, true, rx_array=array, tx_array=array, powers=False)


def scene_materials(paths: PathSet) -> np.ndarray:
    """Permittivity and conductivity of each material, as the scene has them."""
    first = [int(np.argmax(np.asarray(paths.object_material) == i)) for i in range(paths.n_material)]
    return np.stack([np.asarray(value)[first] for value in (paths.permittivity, paths.conductivity)])


def stored(
    paths: PathSet, statistics: Statistics, start: np.ndarray
) -> Callable[[], tuple[float, np.ndarray]]:
    """Value and gradient in permittivity and conductivity of each material, from stored paths."""

    def loss(materials: jax.Array, paths: PathSet, seen: Statistics) -> jax.Array:
        gain = path_gain(paths, *(value[paths.object_material] for value in materials))
        fit = jnp.einsum("lp,lpq,lq->", jnp.conj(gain), seen.gram, gain)
        fit -= 2 * jnp.sum(jnp.conj(gain) * seen.product[:, 0])
        return SCALE * (jnp.sum(seen.energy) + jnp.real(fit)) / (seen.size * paths.n_link)

    function = jax.jit(jax.value_and_grad(loss))
    materials = jnp.asarray(start)

    def step() -> tuple[float, np.ndarray]:
        value, gradient = jax.block_until_ready(function(materials, paths, statistics))
        return float(value), np.asarray(gradient)

    return step


def traced_again(
    scene: Any, paths: PathSet, statistics: Statistics, start: np.ndarray, samples: int, *, keep: bool
) -> Callable[[], tuple[float, np.ndarray]]:
    """The same, by Sionna's path solver at every step and Dr.Jit's derivatives; it is spared the channel.

    With `keep` the solver finds paths once and computes their fields at every step, which it has no public way to do.
    """
    rt = sionna_rt()
    dr, mi = libraries()
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.remove([*scene.transmitters, *scene.receivers])
    scene.add(rt.Transmitter("tx", np.asarray(paths.tx_position[0]).tolist()))
    for number, place in enumerate(np.asarray(paths.rx_position).tolist()):
        scene.add(rt.Receiver(f"rx-{number}", place))
    solver = rt.PathSolver(deterministic=True)
    solver.loop_mode = "evaluated"
    materials = [scene.radio_materials[name] for name in paths.material_names]
    loss_of, _ = mean_square(paths, statistics, SCALE)

    def solve() -> Any:
        with repaired_sionna(), large_table():
            return solver(scene, max_depth=3, samples_per_src=samples, refraction=False, seed=1)

    order = mi.UInt32(slots(solve(), paths))
    if keep:
        keep_paths(solver)
        solve()

    def step() -> tuple[float, np.ndarray]:
        values = [[dr.opaque(mi.Float, float(value)) for value in pair] for pair in start.T]
        for material, (permittivity, conductivity) in zip(materials, values, strict=True):
            dr.enable_grad(permittivity, conductivity)
            material.relative_permittivity, material.conductivity = permittivity, conductivity
        found = solve()
        gain = mi.Complex2f(*(dr.gather(mi.Float, part.array, order) for part in found.a))
        loss = loss_of(gain)
        dr.backward(loss)
        slopes = [[float(np.asarray(dr.grad(value))[0]) for value in pair] for pair in values]
        return float(np.asarray(loss).reshape(-1)[0]), np.asarray(slopes).T

    return step


def keep_paths(solver: Any) -> None:
    """Let a solver hand its next paths to every later call."""
    kept: list[Any] = []
    generate, reflect = solver._candidate_generator, solver._image_method  # noqa: SLF001

    def generated(**arguments: Any) -> Any:
        return kept[0] if kept else generate(**arguments)

    def reflected(**arguments: Any) -> Any:
        if not kept:
            kept.append(reflect(**arguments))
            kept[0].shrink = lambda: None
        return kept[0]

    solver._candidate_generator, solver._image_method = generated, reflected  # noqa: SLF001


def slots(found: Any, paths: PathSet) -> np.ndarray:
    """Where the solver keeps each of the stored paths, told by their delays; it may hold a path twice."""
    valid, delay = np.asarray(found.valid)[:, 0], np.asarray(found.tau, np.float64)[:, 0]
    stored, mask = np.asarray(paths.delay, np.float64), np.asarray(paths.mask)
    order = np.argsort(np.where(valid, delay, np.inf), axis=1, kind="stable")
    place = np.zeros(mask.shape, int)
    for link in range(len(mask)):
        free = order[link].tolist()
        for path in np.flatnonzero(mask[link]):
            near = [slot for slot in free if abs(delay[link, slot] - stored[link, path]) < SAME_DELAY]
            if not near:
                sys.exit(f"the solver has not found path {path} of link {link}")
            free.remove(near[0])
            place[link, path] = near[0]
    link, path = np.nonzero(mask)
    return link * valid.shape[1] + place[link, path]


def compare(name: str, ours: tuple[float, np.ndarray], theirs: tuple[float, np.ndarray]) -> None:
    """Say how far two answers are apart; the path solver keeps vertices in single precision."""
    gradient = np.max(np.abs(ours[1] - theirs[1])) / np.max(np.abs(ours[1]))
    print(
        f"{name}: value {theirs[0]:.6g}, jax {ours[0]:.6g}; gradients differ by {gradient:.1e} of the largest"
    )
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


def write(
    options: argparse.Namespace, paths: PathSet, times: dict[str, float], ratios: dict[str, float]
) -> None:
    """Keep the figure."""
    figures = {
        "size": {
            "links": options.links,
            "antennas": [options.side**2] * 2,
            "subcarriers": options.subcarriers,
            "paths": int(paths.mask.sum()),
        },
        "rays": options.samples,
        "milliseconds": {name: round(1e3 * value, 3) for name, value in times.items()},
        "times_jax": {name: round(value, 1) for name, value in ratios.items()},
    }
    what = "value and gradient of mean |H - y|^2 in the materials, munich, depth 3"
    record("field", what, ("jax", "sionna-rt", "drjit"), figures)


if __name__ == "__main__":
    main()
