"""Rate after beam alignment against the number of labelled positions, for an array of 200 antennas."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import PRNGKeyArray

from dtprob.models.prediction_powered.schemes import SCHEMES
from dtprob.reproduce import beam_alignment
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress

RUNS: Final = beam_alignment.RUNS
ROWS: Final = 20
LABELLED: Final = (100, 200, 300, 500, 1000, 2000, 3000)


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    paths = beam_alignment.positions(progress)
    return figure(beam_alignment.Campaign(key, runs, progress, paths), LABELLED)


def figure(campaign: beam_alignment.Campaign, labelled: Sequence[int]) -> Figure:
    """The figure for given numbers of labels."""
    table = np.stack([campaign.cell(ROWS, n) for n in labelled], axis=-1)
    names = list(SCHEMES)
    series = [Series.of_runs(name, labelled, table[:, index, 0]) for index, name in enumerate(names)]
    axis = Quantity("labelled positions", is_log=True)
    panel = Panel("200 antennas", axis, beam_alignment.RATE, tuple(series))
    lam = table[:, names.index("tuned_cppi"), 1].mean(axis=0)
    shown = ", ".join(f"{value:.2f} at {n}" for n, value in zip(labelled, lam, strict=True))
    notes = (*campaign.notes, f"mean lambda of tuned_cppi: {shown}")
    return Figure("fig10", "beam alignment with synthetic labels", (panel,), campaign.runs, notes)
