"""The evidence of a change that lasts: of all windows since together, not of each by itself."""

import numpy as np

from dtprob.models.dirichlet import log_marginal
from dtprob.twin import statistics
from dtprob.workflow.loop.knowledge import evidence_since

FRESH, LEARNED = np.full((1, 4), 0.5), np.array([[14.5, 12.5, 14.5, 0.5]])


def windows(count, probability, seed=1):
    """Outcomes of ten slots in each window."""
    return np.random.default_rng(seed).multinomial(10, probability, count)[:, None].astype(float)


def test_evidence_is_that_of_the_summed_counts():
    counts = windows(6, [0.4, 0.3, 0.2, 0.1])
    found = evidence_since(FRESH, LEARNED, counts)
    for end in range(6):
        for lag in range(6):
            own = counts[max(end - lag, 0) : end + 1].sum(0)
            expected = float((log_marginal(FRESH, own) - log_marginal(LEARNED, own)).sum())
            assert np.isclose(found[end, lag], expected if lag <= end else -np.inf)


def test_a_small_change_that_lasts_is_found_by_all_windows_together():
    found = evidence_since(FRESH, 10 * LEARNED, windows(100, [0.25, 0.48, 0.25, 0.02]))
    assert found[-1].max() > np.log(1000)
    assert statistics.detector(found[:, 0]).max() < np.log(
        1000
    )  # each window by itself pays for a law of its own


def test_nothing_is_gathered_where_nothing_changed():
    found = evidence_since(FRESH, LEARNED, windows(40, [0.35, 0.3, 0.34, 0.01]))
    assert np.logaddexp.reduce(found, axis=1).max() < np.log(1000)
