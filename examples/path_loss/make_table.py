"""Writes table.csv: a drive through 30 streets, in which the harbour site sends 5 dB less than it should.

    python examples/path_loss/make_table.py
    dtprob diagnose examples/path_loss/case.toml --out out/path_loss

Neighbouring rows are alike: parked lorries, trees and the houses' height give each street a level of its own, 4 dB in
standard deviation. Row by row such levels look like causes; street by street they are what they are.
"""

from pathlib import Path

import numpy as np
from path_loss import SITES

STREETS, ROWS = 30, 14
STREET_DB, ERROR_DB, LOSS_DB = 4.0, 2.5, 5.0


def table(seed: int, loss_db: float) -> np.ndarray:
    """Rows of east, north (m), time (min), site, segment, power (dBm)."""
    random = np.random.default_rng(seed)
    centre = random.uniform([40, 40], [760, 460], (STREETS, 1, 2))
    angle = random.uniform(0, np.pi, (STREETS, 1))
    along = np.linspace(-40, 40, ROWS)
    place = (centre + np.stack([np.cos(angle) * along, np.sin(angle) * along], axis=-1)).reshape(-1, 2)
    time = np.sort(random.uniform(0, 90, len(place)))
    segment = np.repeat(np.arange(STREETS), ROWS)
    sites = np.array(list(SITES.values()))
    away = np.sqrt(np.sum((place[:, None] - sites[:, :2]) ** 2, axis=2) + sites[:, 2] ** 2)
    site = np.argmin(away, axis=1)
    power = -33 - 31 * np.log10(away[np.arange(len(place)), site]) - loss_db * (site == 0)
    power += (STREET_DB * random.standard_normal(STREETS))[segment]
    power += ERROR_DB * random.standard_normal(len(place))
    return np.column_stack([place, time, site, segment, power])


def write(file: Path, rows: np.ndarray) -> None:
    """The table as CSV."""
    form = ["%.1f", "%.1f", "%.2f", "%d", "%d", "%.2f"]
    header = "east,north,time,site,segment,power"
    np.savetxt(file, rows, fmt=form, delimiter=",", header=header, comments="")


if __name__ == "__main__":
    write(Path(__file__).with_name("table.csv"), table(seed=3, loss_db=LOSS_DB))
