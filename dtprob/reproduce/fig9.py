"""Rate after beam alignment against the number of antennas, for 300 and for 3000 labelled positions."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import PRNGKeyArray

from dtprob.models.prediction_powered.schemes import SCHEMES
from dtprob.reproduce import beam_alignment
from dtprob.reproduce.beam_alignment import RATE, Campaign, Case
from dtprob.reproduce.beam_findings import gain, standing
from dtprob.reproduce.beams_codebook import Arrays
from dtprob.reproduce.beams_file import read_paths
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress

RUNS: Final = beam_alignment.RUNS
ROWS: Final = (5, 10, 20, 30, 40, 50, 80, 100, 160)
LABELLED: Final = (300, 3000)


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    return figure(Campaign(key, runs, progress, read_paths()), ROWS, LABELLED)


def figure(campaign: Campaign, rows: Sequence[int], labelled: Sequence[int]) -> Figure:
    """The figure for given widths of the array and numbers of labels."""
    panels: list[Panel] = []
    notes: list[str] = []
    for n in labelled:
        rate = np.stack([campaign.cell(Case(Arrays(width), n)) for width in rows], axis=-1)[:, :, 0]
        antennas = [Arrays(width).antennas for width in rows]
        series = [Series.of_runs(name, antennas, rate[:, index]) for index, name in enumerate(SCHEMES)]
        title = f"{n} labelled positions"
        panels.append(Panel(title, Quantity("antennas", is_log=True), RATE, tuple(series)))
        gains = [gain(rate, antennas, count) for count in (antennas[0], antennas[-1])]
        notes += [f"{title}: {text}" for text in (*gains, standing(rate, antennas))]
    title = "beam alignment with synthetic labels"
    return Figure("fig9", title, tuple(panels), campaign.runs, (*campaign.notes, *notes))
