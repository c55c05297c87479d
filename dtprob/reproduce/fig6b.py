"""Power error after calibration against the spread of phase errors, the noise and the size of the arrays."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from dtprob.raytracing.calibration import SCHEMES
from dtprob.reproduce import calibration_urban as urban
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress

RUNS: Final = 10
SPREADS_DEG: Final = (0.0, 11.6, 23.1, 34.7, 46.2, 57.7, 69.3, 80.8, 92.4, 103.9)
CONCENTRATIONS: Final = (np.inf, 25.0, 6.70, 3.42, 2.25, 1.60, 1.12, 0.721, 0.358, 0.0)
SNR_DB: Final = (-30.0, -15.0, 0.0, 15.0, 30.0)
SIDES: Final = (1, 2, 4, 8)

ERROR: Final = Quantity("relative power error", is_log=True)

type Errors = dict[str, Float[np.ndarray, " run"]]


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    study = Study(key, runs, progress)
    return study.figure(CONCENTRATIONS, SPREADS_DEG, SNR_DB, SIDES)


class Study:
    """Measurements of the urban scene with von Mises errors on the phases of its paths; noise is the same everywhere."""

    def __init__(self, key: PRNGKeyArray, runs: int, progress: Progress) -> None:
        self._key, self._runs, self._progress = key, runs, progress

    def figure(
        self,
        concentrations: Sequence[float],
        spreads: Sequence[float],
        ratios: Sequence[float],
        sides: Sequence[int],
    ) -> Figure:
        """The figure on other grids."""
        uniform = "phases uniform"
        panels = (
            self._panel(
                "8x8 antennas at both ends, 20 dB",
                Quantity("phase-error std", "deg"),
                spreads,
                [lambda k=k: self.cell(k, urban.SNR_DB, urban.SIDE) for k in concentrations],
            ),
            self._panel(
                f"8x8 antennas, {uniform}",
                Quantity("SNR", "dB"),
                ratios,
                [lambda ratio=ratio: self.cell(0.0, ratio, urban.SIDE) for ratio in ratios],
            ),
            self._panel(
                f"{uniform}, 20 dB",
                Quantity("antennas at either end", is_log=True),
                [side**2 for side in sides],
                [lambda side=side: self.cell(0.0, urban.SNR_DB, side) for side in sides],
            ),
        )
        return Figure("fig6b", "calibration under phase errors", panels, self._runs, urban.NOTES)

    def cell(self, concentration: float, ratio_db: float, side: int) -> Errors:
        """Errors of all schemes by run, for one setting."""
        name = f"concentration {concentration:g}, {ratio_db:g} dB, {side}x{side} antennas, {self._runs} runs"
        return self._progress.part(name, lambda: self._measured(concentration, ratio_db, side))

    def _measured(self, concentration: float, ratio_db: float, side: int) -> Errors:
        runs = [urban.measured(self._key, run, concentration, ratio_db, side) for run in range(self._runs)]
        return urban.errors(runs, ratio_db)

    def _panel(
        self, title: str, x: Quantity, at: Sequence[float], cells: Sequence[Callable[[], Errors]]
    ) -> Panel:
        each = [cell() for cell in cells]
        series = [
            Series.of_runs(scheme, list(at), np.stack([errors[scheme] for errors in each], axis=1))
            for scheme in SCHEMES
        ]
        return Panel(title, x, ERROR, tuple(series))
