"""Figure 10 with a learned map, that of a Gaussian process, in the place of the inverse-distance one."""

from collections.abc import Sequence
from typing import Final

from jaxtyping import PRNGKeyArray

from dtprob.reproduce import beam_alignment
from dtprob.reproduce.beam_alignment import Campaign, Case
from dtprob.reproduce.beams_codebook import Arrays
from dtprob.reproduce.beams_file import read_paths
from dtprob.reproduce.fig10 import ROWS, drawn
from dtprob.reproduce.figure import Figure
from dtprob.reproduce.progress import Progress

RUNS: Final = beam_alignment.RUNS
LABELLED: Final = (100, 300, 1000)


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    return figure(Campaign(key, runs, progress, read_paths()), LABELLED)


def figure(campaign: Campaign, labelled: Sequence[int]) -> Figure:
    """The figure for given numbers of labels."""
    cases = {"map of a Gaussian process": Case(Arrays(ROWS), 0, "gaussian_process")}
    return drawn("fig10_learned", campaign, cases, labelled)
