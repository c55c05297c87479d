"""Figure 3 in small: every curve is there, windows are weighed exactly, and the order of the methods holds."""

import jax
import numpy as np
import pytest

from dtprob.reproduce import fig3
from dtprob.reproduce import monitor_windows as monitor
from dtprob.reproduce.progress import Progress
from dtprob.twin import statistics


def test_windows_are_all_and_weighed():
    windows = monitor.Windows(5)
    assert len(windows.counts) == 21
    for law in (monitor.NORMAL, monitor.CHANGED):
        assert windows.probability(law).sum() == pytest.approx(1.0)
        np.testing.assert_allclose(windows.probability(law) @ windows.counts, 5 * law, atol=1e-12)


@pytest.mark.study
def test_the_best_detector_bounds_all():
    """Neyman and Pearson: no statistic has a larger area than the likelihood ratio of the true laws."""
    windows = monitor.Windows(5)
    normal, changed = windows.probability(monitor.NORMAL), windows.probability(monitor.CHANGED)
    best = statistics.area(changed / normal, normal, changed)
    counts, draws = monitor.learn(jax.random.key(0), 20, 30)
    fresh = monitor.fresh_draws(jax.random.key(1))
    areas = {name: [] for name in monitor.METHODS}
    for model in range(30):
        for name, statistic in monitor.judge(counts[model], draws[:, model], fresh, windows).items():
            areas[name].append(statistics.area(statistic, normal, changed))
    assert all(max(values) <= best + 1e-12 for values in areas.values())
    means = {name: np.mean(values) for name, values in areas.items()}
    assert means["map"] < means["bayesian"] < means["evidence_disconnected"]


def test_the_figure():
    figure = fig3.run(jax.random.key(0), 3, Progress())
    assert [panel.title.split(",")[0] for panel in figure.panels] == ["ROC"] * 2 + ["area under the ROC"] * 2
    assert {"bayesian_T20", "map_T20", "bayesian_T50", "map_T50"} <= {s.name for s in figure.panels[0].series}
    assert all(np.all((s.low >= 0) & (s.high <= 1)) for panel in figure.panels for s in panel.series)
