"""Detection of a disconnected device: ROC, and the area under it over models learned from 20 and from 50 slots."""

from typing import Final

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from dtprob.reproduce import monitor_windows as monitor
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress
from dtprob.twin import statistics

RUNS: Final = 400
"""Models of each size of the training set."""
FEW: Final = 50
"""As many models as the report has; the first of all."""
SLOTS: Final = (20, 50)
LENGTHS: Final = (5, 20)
_GRID: Final = np.linspace(0.0, 1.0, 41)

type Results = dict[tuple[int, int], dict[str, np.ndarray]]


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    found: Results = {
        (length, slots): progress.part(
            f"windows of {length} slots, {runs} models of {slots} slots",
            lambda length=length, slots=slots: _cell(key, runs, length, slots),
        )
        for length in LENGTHS
        for slots in SLOTS
    }
    roc = [_roc_panel(found, length) for length in LENGTHS]
    area = [_area_panel(found, length, runs) for length in LENGTHS]
    title = "detection of a disconnected device"
    return Figure("fig3", title, (*roc, *area), runs, tuple(_notes(found, runs)))


def _cell(key: PRNGKeyArray, runs: int, length: int, slots: int) -> dict[str, np.ndarray]:
    """Detection rates on the grid, `<method>.roc` (model, point), and areas, `<method>.area` (model,)."""
    windows = monitor.Windows(length)
    normal, changed = windows.probability(monitor.NORMAL), windows.probability(monitor.CHANGED)
    counts, draws = monitor.learn(jax.random.fold_in(key, slots), slots, runs)
    fresh = monitor.fresh_draws(jax.random.fold_in(key, 0))
    result: dict[str, list[np.ndarray]] = {}
    for model in range(runs):
        for name, statistic in monitor.judge(counts[model], draws[:, model], fresh, windows).items():
            false, true = statistics.roc(statistic, normal, changed)
            result.setdefault(f"{name}.roc", []).append(np.interp(_GRID, false, true))
            result.setdefault(f"{name}.area", []).append(np.array(np.trapezoid(true, false)))
    return {name: np.stack(values) for name, values in result.items()}


def _roc_panel(found: Results, length: int) -> Panel:
    series = [
        Series.of_runs(f"{name}_T{slots}", _GRID, found[length, slots][f"{name}.roc"])
        for slots in SLOTS
        for name in monitor.METHODS
    ]
    title = f"ROC, windows of {length} slots"
    return Panel(title, Quantity("false-alarm rate"), Quantity("detection rate"), tuple(series))


def _area_panel(found: Results, length: int, runs: int) -> Panel:
    sizes = {f"_{FEW}": FEW, "": runs} if runs > FEW else {"": runs}
    series = [
        Series.of_runs(
            name + label, SLOTS, np.stack([found[length, t][f"{name}.area"][:size] for t in SLOTS], axis=-1)
        )
        for label, size in sizes.items()
        for name in monitor.METHODS
    ]
    title = f"area under the ROC, windows of {length} slots"
    return Panel(title, Quantity("training slots"), Quantity("area"), tuple(series))


def _notes(found: Results, runs: int) -> list[str]:
    notes = [
        "Statistics of one cluster's arrivals, likelihoods in log space; every window weighed by its probability.",
        (
            "bayesian: standard deviation of the log likelihood over 1000 posterior draws; map: minus the log likelihood"
            " at the mode; evidence: log Bayes factor of Jeffreys' prior against the posterior; evidence_disconnected:"
            " of the posterior with either device silent."
        ),
    ]
    for length in LENGTHS:
        for slots in SLOTS:
            for size in sorted({min(FEW, runs), runs}):
                parts = []
                for name in monitor.METHODS:
                    area = found[length, slots][f"{name}.area"][:size]
                    error = area.std() / np.sqrt(size)
                    quartile = np.quantile(area, 0.25)
                    parts.append(f"{name} {area.mean():.3f} +- {error:.3f} ({quartile:.3f})")
                notes.append(
                    f"mean area, standard error and lower quartile, windows of {length}, T={slots}, {size} models: "
                    + ", ".join(parts)
                )
    return notes
