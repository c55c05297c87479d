"""Rate after beam alignment against the number of labelled positions, for an array of 200 antennas.

Besides the user with one antenna: one with two, so that a pair of beams is chosen, and the map of a Gaussian
process in the place of the inverse-distance one.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy import stats

from dtprob.models.prediction_powered.schemes import SCHEMES
from dtprob.reproduce import beam_alignment
from dtprob.reproduce.beam_alignment import RATE, Campaign, Case
from dtprob.reproduce.beams_codebook import Arrays
from dtprob.reproduce.beams_file import read_paths
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress

RUNS: Final = beam_alignment.RUNS
ROWS: Final = 20
LABELLED: Final = (100, 200, 300, 500, 1000, 2000, 3000)
FEW: Final = 1000
"""Most labels for which the map of a Gaussian process is made: its cost grows with their square."""

_STATED: Final = 300
_LEVEL: Final = 0.9


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    return figure(Campaign(key, runs, progress, read_paths()), LABELLED)


def figure(campaign: Campaign, labelled: Sequence[int]) -> Figure:
    """The figure for given numbers of labels."""
    one, two = Arrays(ROWS), Arrays(ROWS, user=2)
    kinds = {
        "user with one antenna": (one, "inverse_distance"),
        "user with two antennas: a pair of beams": (two, "inverse_distance"),
        "user with one antenna, map of a Gaussian process": (one, "gaussian_process"),
    }
    panels: list[Panel] = []
    notes: list[str] = []
    for title, (arrays, kind) in kinds.items():
        shown = [n for n in labelled if kind != "gaussian_process" or n <= FEW]
        table = np.stack([campaign.cell(Case(arrays, n, kind)) for n in shown], axis=-1)
        curves = [Series.of_runs(name, shown, table[:, i, 0]) for i, name in enumerate(SCHEMES)]
        axis = Quantity("labelled positions", is_log=True)
        panels.append(Panel(title, axis, RATE, tuple(curves)))
        notes += [f"{title}: {text}" for text in _findings(table, shown)]
    title = f"beam alignment with synthetic labels, {one.antennas} antennas"
    return Figure("fig10", title, tuple(panels), campaign.runs, (*campaign.notes, *notes))


def _findings(table: Float[np.ndarray, "run scheme 2 point"], labelled: Sequence[int]) -> list[str]:
    """Lambda, the gain over ERM and the largest shortfall against the best other scheme."""
    names = list(SCHEMES)
    tuned = names.index("tuned_cppi")
    lam = table[:, tuned, 1].mean(axis=0)
    shown = ", ".join(f"{value:.2f} at {n}" for n, value in zip(labelled, lam, strict=True))
    found = [f"mean lambda of tuned_cppi {shown}"]
    at = labelled.index(_STATED) if _STATED in labelled else 0
    gain = table[:, tuned, 0, at] - table[:, names.index("erm"), 0, at]
    if len(gain) > 1:
        half = stats.t.ppf((1 + _LEVEL) / 2, len(gain) - 1) * gain.std(ddof=1) / np.sqrt(len(gain))
        interval = f"90% interval {gain.mean() - half:.3f} to {gain.mean() + half:.3f}"
        found.append(f"mean gain over erm at {labelled[at]}: {gain.mean():.3f} bit/s/Hz, {interval}")
    rate = np.median(table[:, :, 0], axis=0)
    others = np.delete(rate, tuned, axis=0)
    short = others.max(axis=0) - rate[tuned]
    worst = int(np.argmax(short))
    best = np.delete(np.array(names), tuned)[others[:, worst].argmax()]
    text = f"median of tuned_cppi minus that of the best other: least {-short[worst]:.3f} bit/s/Hz"
    return [*found, f"{text}, at {labelled[worst]} ({best})"]
