"""The scene of figure 8 and its wave simulation, kept as a small file that comes with dtprob.

    python -m dtprob.reproduce.fig8_scene [FILE [CELLS]]

makes the file anew, with a grid of CELLS cells per wavelength. Two concrete walls stand 40 wavelengths above
and 50 below the line from the transmitter to three receivers, which a metal blocker cuts.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from dtprob.files import atomic_write
from dtprob.physical.channel import subcarriers
from dtprob.physical.wave import CONCRETE, METAL, Rectangle, Scene2D, simulate
from dtprob.physical.world import SPEED_OF_LIGHT

CARRIER: Final = 6e9
WAVELENGTH: Final = SPEED_OF_LIGHT / CARRIER
BANDWIDTHS: Final = (100e6, 200e6, 500e6)
SUBCARRIERS: Final = 64
DURATION: Final = 100e-9
CELLS: Final = 20.0
"""Per wavelength; every side of the scene but the far ones of the walls then lies on nodes."""
THICKNESS: Final = 0.2
"""Of the walls, m."""
UPPER: Final = 40 * WAVELENGTH
LOWER: Final = -50 * WAVELENGTH
"""Where the faces of the walls are, m."""
BLOCKER: Final = ((-0.5 * WAVELENGTH, -16 * WAVELENGTH), (0.5 * WAVELENGTH, 14 * WAVELENGTH))
"""Its corners, m: 1 x 30 wavelengths, its middle 1 wavelength below the line."""
TX: Final = (-30 * WAVELENGTH, 0.0)
RX: Final = tuple((distance * WAVELENGTH, 0.0) for distance in (20, 30, 40))
FILE: Final = Path(__file__).with_name("fig8_field.npz")


class Simulated(NamedTuple):
    """The simulated channel, with the spreading of a cylinder (`dtprob.physical.wave.simulate.Response`).

    Attributes:
        channel: at the three receivers.
        tail: what the end of the simulation cut off, over the largest field.
        cells: per wavelength.
    """

    channel: Complex[np.ndarray, "rx bandwidth subcarrier"]
    tail: float
    cells: float


def subcarrier_frequency(bandwidth: float) -> Float[np.ndarray, " subcarrier"]:
    """Hz from the carrier."""
    return subcarriers(SUBCARRIERS, bandwidth)


def scene() -> Scene2D:
    """What stands there."""
    wide = float("inf")
    return Scene2D(
        (-34 * WAVELENGTH, -55 * WAVELENGTH),
        (44 * WAVELENGTH, 45 * WAVELENGTH),
        (
            Rectangle((-wide, UPPER), (wide, UPPER + THICKNESS), CONCRETE),
            Rectangle((-wide, LOWER - THICKNESS), (wide, LOWER), CONCRETE),
            Rectangle(*BLOCKER, METAL),
        ),
    )


def simulate_scene(cells: float = CELLS, report: Callable[[int, int], None] | None = None) -> Simulated:
    """Simulate the scene; two minutes of processor time at 16 cells, in proportion to their cube.

    Args:
        cells: per wavelength.
        report: called with the steps done and their number.
    """
    offset = np.concatenate([subcarrier_frequency(bandwidth) for bandwidth in BANDWIDTHS])
    found = simulate(
        scene(), TX, np.array(RX), CARRIER + offset, duration=DURATION, cells=cells, report=report
    )
    channel = found.channel.reshape(len(RX), len(BANDWIDTHS), SUBCARRIERS)
    return Simulated(channel, found.tail, cells)


def read_simulated(file: Path = FILE) -> Simulated:
    """What `main` kept."""
    with np.load(file, allow_pickle=False) as stored:
        return Simulated(stored["channel"], float(stored["tail"]), float(stored["cells"]))


def main() -> None:
    """Simulate the scene and keep the channel."""
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else FILE
    cells = float(sys.argv[2]) if len(sys.argv) > 2 else CELLS
    found = simulate_scene(cells, lambda done, steps: print(f"{done} of {steps} steps", flush=True))
    with atomic_write(file) as part:
        np.savez_compressed(part, allow_pickle=False, **found._asdict())
    print(f"written to {file}; {found.tail:.1e} of the largest field was left")


if __name__ == "__main__":
    main()
