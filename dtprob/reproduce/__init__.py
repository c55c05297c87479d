"""The figures of the seed report and the evidence for what dtprob claims, each made by one command.

A figure's module has `run(key, runs, progress) -> Figure` and `RUNS`, the number of runs by default.
"""

from collections.abc import Mapping
from typing import Final

FIGURES: Final[Mapping[str, str]] = {
    "fig3": "dtprob.reproduce.fig3",
    "collection": "dtprob.reproduce.network_collection",
    "fig2": "dtprob.reproduce.fig2",
    "prediction": "dtprob.reproduce.prediction",
    "fig5": "dtprob.reproduce.fig5",
    "fig6a": "dtprob.reproduce.fig6a",
    "fig6b": "dtprob.reproduce.fig6b",
    "fig7": "dtprob.reproduce.fig7",
    "fig8": "dtprob.reproduce.fig8",
    "fig9": "dtprob.reproduce.fig9",
    "fig10": "dtprob.reproduce.fig10",
    "fig10_learned": "dtprob.reproduce.fig10_learned",
    "label_grid": "dtprob.reproduce.label_grid",
    "deepsense": "dtprob.reproduce.deepsense",
    "apartment": "dtprob.reproduce.apartment",
}
"""For each figure's name, the module that makes it."""
