"""Where along a corridor are receivers on average? Few surveyed places, many readings, a biased prediction.

    python examples/labels/rssi.py     # writes examples/labels/rssi.csv
    dtprob fit examples/labels/case.toml --out out/rssi

Three access points are heard in a corridor of 40 m. The predicted place comes from the path-loss law of free
rooms, which is wrong across the fire door at 25 m. Surveyed places are dear, readings are free: the mean of
the 60 places has a standard error of 1.6 m, that of all predictions is biased, both together have one of 0.4 m.
"""

from pathlib import Path

import numpy as np

ACCESS_POINTS = np.array([2.0, 20.0, 38.0])
SURVEYED, READINGS = 60, 1500
DOOR, LOSS_DB = 25.0, 9.0


def main() -> None:
    """Simulate the readings and write them, most without a label."""
    random = np.random.default_rng(6)
    place = random.uniform(0, 40, READINGS)
    distance = np.hypot(place[:, None] - ACCESS_POINTS, 2.0)
    behind = (place[:, None] > DOOR) != (ACCESS_POINTS > DOOR)
    strength = -40 - 22 * np.log10(distance) - LOSS_DB * behind + 3 * random.standard_normal(distance.shape)
    prediction = predicted(strength)
    label = np.where(np.arange(READINGS) < SURVEYED, place, np.nan)
    lines = ["x_0,x_1,x_2,y,prediction"]
    for reading, y, guess in zip(strength, label, prediction, strict=True):
        shown = "" if np.isnan(y) else f"{y:.2f}"
        lines.append(",".join([*(f"{value:.1f}" for value in reading), shown, f"{guess:.2f}"]))
    Path(__file__).with_name("rssi.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def predicted(strength: np.ndarray) -> np.ndarray:
    """The place on a grid whose strengths by the law of free rooms are nearest the readings."""
    grid = np.linspace(0, 40, 161)
    law = -40 - 22 * np.log10(np.hypot(grid[:, None] - ACCESS_POINTS, 2.0))
    return grid[np.argmin(np.sum((strength[:, None] - law) ** 2, axis=2), axis=1)]


if __name__ == "__main__":
    main()
