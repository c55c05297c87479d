"""Cell updates per second of processor time: dtprob's wave simulation against beamz and plain NumPy.

    python benchmarks/bench_wave.py [--side 800] [--steps 200] [--write]

All run in turn in one process on the same square of air, in single precision and after compilation; the figures
are medians over rounds. NumPy's is a plain Yee scheme without an absorbing layer. --write keeps the result in
benchmarks/results/wave.json.
"""

import argparse
import time
from collections.abc import Callable

import beamz
import jax
import jax.numpy as jnp
import numpy as np
from record import record

from dtprob.physical.wave import Scene2D
from dtprob.physical.wave.fdtd import advance, factors, patches, rest
from dtprob.physical.wave.grid import ABSORBER, acting, make_grid
from dtprob.physical.wave.scene import rasterise

CARRIER, SPACING = 6e9, 2.5e-3


def main() -> None:
    """Run the benchmark and print its figures."""
    parser = argparse.ArgumentParser(description="Cell updates per second of wave simulations.")
    for name, default in (("side", 800), ("steps", 200), ("rounds", 5)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    runs = {
        "dtprob": ours(options.side, options.steps),
        "beamz": theirs(options.side, options.steps),
        "numpy": plain(options.side, options.steps),
    }
    updates = options.side**2 * options.steps / 1e6
    seconds = in_turns(runs, options.rounds)
    rate = {name: updates / value for name, value in seconds.items()}
    for name, value in rate.items():
        print(f"{name:8s} {value:8.1f} million cells per second of processor time")
    if options.write:
        write(options, rate)


def ours(side: int, steps: int) -> Callable[[], None]:
    """dtprob, with its absorbing layer inside the square and two probes."""
    inner = (side - 2 * ABSORBER - 1) * SPACING
    scene = Scene2D((0.0, 0.0), (inner, inner))
    grid = make_grid(scene, SPACING)
    media = factors(
        grid, rasterise(scene, grid.x, grid.y, lambda medium: acting(grid, CARRIER, medium)), CARRIER
    )
    source, probes = (patches(grid, np.full((count, 2), inner / 2)) for count in (1, 2))
    state = rest(grid)
    current = jnp.ones(steps, jnp.float32)

    def run() -> None:
        nonlocal state
        state, _ = jax.block_until_ready(advance(state, media, source, probes, current))

    return run


def theirs(side: int, steps: int) -> Callable[[], None]:
    """beamz, with its convolutional layer and one recorded place: a whole run of a simulation that it has compiled."""
    width = (side - 1) * SPACING
    step = 0.9 * SPACING / 299_792_458.0 / np.sqrt(2)
    simulation = beamz.Simulation(
        domain=(width, width),
        resolution=SPACING,
        time=np.arange(steps) * step,
        sources=[beamz.CustomSource("Ez", "e", (side // 2, side // 2), 1.0, np.ones(steps), (side, side))],
        monitors=[
            beamz.FieldRecorder(
                ("Ez",), interval=1, name="place", center=(width / 2, width / 2, 0.0), size=(0.0, 0.0, 0.0)
            )
        ],
        boundaries=[beamz.PML(thickness=ABSORBER * SPACING, formulation="cpml")],
        normalize_source=None,
    )

    def run() -> None:
        simulation.run()

    return run


def plain(side: int, steps: int) -> Callable[[], None]:
    """Yee's scheme as one would write it in NumPy."""
    ez = np.zeros((side, side), np.float32)
    hx, hy = np.zeros((side, side - 1), np.float32), np.zeros((side - 1, side), np.float32)
    half = np.float32(0.5)

    def run() -> None:
        for _ in range(steps):
            hx[...] -= half * (ez[:, 1:] - ez[:, :-1])
            hy[...] += half * (ez[1:] - ez[:-1])
            curl = hy[1:, 1:-1] - hy[:-1, 1:-1] - hx[1:-1, 1:] + hx[1:-1, :-1]
            ez[1:-1, 1:-1] += half * curl
            ez[side // 2, side // 2] += 1

    return run


def in_turns(runs: dict[str, Callable[[], None]], rounds: int) -> dict[str, float]:
    """Median processor seconds of each, after one run that does not count."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(rounds):
        for name, run in runs.items():
            begin = time.process_time()
            run()
            times[name].append(time.process_time() - begin)
    return {name: float(np.median(values)) for name, values in times.items()}


def write(options: argparse.Namespace, rate: dict[str, float]) -> None:
    """Keep the figures."""
    figures = {
        "size": {"side": options.side, "steps": options.steps},
        "million_cells_per_processor_second": {name: round(value, 1) for name, value in rate.items()},
        "ratio": {name: round(rate["dtprob"] / rate[name], 2) for name in rate if name != "dtprob"},
    }
    what = "cell updates of a two-dimensional wave simulation"
    record("wave", what, ("jax", "beamz", "numpy"), figures)


if __name__ == "__main__":
    main()
