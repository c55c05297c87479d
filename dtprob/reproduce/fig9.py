"""Rate after beam alignment against the number of antennas, for 300 and for 3000 labelled positions."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import PRNGKeyArray

from dtprob.models.prediction_powered.schemes import SCHEMES
from dtprob.reproduce import beam_alignment
from dtprob.reproduce.beams_codebook import VERTICAL
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress

RUNS: Final = beam_alignment.RUNS
ROWS: Final = (5, 10, 20, 30, 40, 50, 80, 100, 160)
LABELLED: Final = (300, 3000)


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    paths = beam_alignment.positions(progress)
    return figure(beam_alignment.Campaign(key, runs, progress, paths), ROWS, LABELLED)


def figure(campaign: beam_alignment.Campaign, rows: Sequence[int], labelled: Sequence[int]) -> Figure:
    """The figure for given widths of the array and numbers of labels."""
    panels: list[Panel] = []
    for n in labelled:
        rate = np.stack([campaign.cell(width, n) for width in rows], axis=-1)[:, :, 0]
        series = [
            Series.of_runs(name, [VERTICAL * width for width in rows], rate[:, index])
            for index, name in enumerate(SCHEMES)
        ]
        title = f"{n} labelled positions"
        panels.append(Panel(title, Quantity("antennas", is_log=True), beam_alignment.RATE, tuple(series)))
    title = "beam alignment with synthetic labels"
    return Figure("fig9", title, tuple(panels), campaign.runs, campaign.notes)
