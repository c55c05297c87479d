"""Rate after beam alignment against the number of labelled positions, for an array of 200 antennas.

Besides the user with one antenna: one with two, so that a pair of beams is chosen.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float, PRNGKeyArray

from dtprob.models.prediction_powered.schemes import SCHEMES
from dtprob.reproduce import beam_alignment
from dtprob.reproduce.beam_alignment import RATE, Campaign, Case
from dtprob.reproduce.beam_findings import gain, standing
from dtprob.reproduce.beams_codebook import Arrays
from dtprob.reproduce.beams_file import read_paths
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress

RUNS: Final = beam_alignment.RUNS
ROWS: Final = 20
LABELLED: Final = (100, 200, 300, 500, 1000, 2000, 3000)
_STATED: Final = 300


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    return figure(Campaign(key, runs, progress, read_paths()), LABELLED)


def figure(campaign: Campaign, labelled: Sequence[int]) -> Figure:
    """The figure for given numbers of labels."""
    cases = {
        "user with one antenna": Case(Arrays(ROWS), 0),
        "user with two antennas: a pair of beams": Case(Arrays(ROWS, user=2), 0),
    }
    return drawn("fig10", campaign, cases, labelled)


def drawn(name: str, campaign: Campaign, cases: Mapping[str, Case], labelled: Sequence[int]) -> Figure:
    """A figure with a panel per case, whose number of labels is on the axis."""
    panels: list[Panel] = []
    notes: list[str] = []
    for title, case in cases.items():
        table = np.stack([campaign.cell(case._replace(n=n)) for n in labelled], axis=-1)
        curves = [Series.of_runs(scheme, labelled, table[:, i, 0]) for i, scheme in enumerate(SCHEMES)]
        axis = Quantity("labelled positions", is_log=True)
        panels.append(Panel(title, axis, RATE, tuple(curves)))
        notes += [f"{title}: {text}" for text in _findings(table, labelled)]
    title = f"beam alignment with synthetic labels, {Arrays(ROWS).antennas} antennas"
    return Figure(name, title, tuple(panels), campaign.runs, (*campaign.notes, *notes))


def _findings(table: Float[np.ndarray, "run scheme 2 point"], labelled: Sequence[int]) -> list[str]:
    """Lambda, the gain over ERM, and where the tuned scheme is not the best."""
    rate, lam = table[:, :, 0], table[:, list(SCHEMES).index("tuned_cppi"), 1].mean(axis=0)
    shown = ", ".join(f"{value:.2f} at {n}" for n, value in zip(labelled, lam, strict=True))
    at = _STATED if _STATED in labelled else labelled[0]
    return [f"mean lambda of tuned_cppi {shown}", gain(rate, labelled, at), standing(rate, labelled)]
