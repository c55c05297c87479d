"""The evidence of a change that lasts: of all windows since together, not of each by itself."""

import itertools

import numpy as np
import pytest

from dtprob.models.dirichlet import log_marginal
from dtprob.twin import statistics
from dtprob.workflow.loop.knowledge import evidence_since

FRESH, LEARNED = np.full((1, 4), 0.5), np.array([[14.5, 12.5, 14.5, 0.5]])


def windows(count, probability, seed=1):
    """Outcomes of ten slots in each window."""
    return np.random.default_rng(seed).multinomial(10, probability, count)[:, None].astype(float)


def test_evidence_is_that_of_the_summed_counts_against_all_before():
    counts = windows(6, [0.4, 0.3, 0.2, 0.1])
    found = evidence_since(FRESH, LEARNED, counts)
    for end in range(6):
        for lag in range(6):
            own, before = counts[max(end - lag, 0) : end + 1].sum(0), counts[: max(end - lag, 0)].sum(0)
            expected = float((log_marginal(FRESH, own) - log_marginal(LEARNED + before, own)).sum())
            assert np.isclose(found[end, lag], expected if lag <= end else -np.inf)


def test_evidence_is_1_on_average_while_nothing_changed():
    """By enumeration of all outcomes of four windows of one slot under the learned law."""
    fresh, learned = np.array([[0.5, 0.5]]), np.array([[3.2, 0.9]])
    every = np.eye(2)[np.array(list(itertools.product((0, 1), repeat=4)))][:, :, None]
    chance = np.exp([log_marginal(learned, each.sum(axis=0)).sum() for each in every])
    assert np.isclose(chance.sum(), 1.0)
    mean = sum(
        p * np.exp(evidence_since(fresh, learned, each)) for p, each in zip(chance, every, strict=True)
    )
    assert np.allclose(mean, np.tril(np.ones((4, 4))))


def alarm_of(learned_slots, parts, seed, run_length=1000):
    """The window in which the detector calls, of windows after some slots that were learned from; None without."""
    random = np.random.default_rng(seed)
    learned = FRESH + random.multinomial(learned_slots, parts[0][1])
    seen = np.concatenate([random.multinomial(10, chances, count) for count, chances in parts])
    found = evidence_since(FRESH, learned, seen[:, None].astype(float))
    crossed = np.flatnonzero(np.logaddexp.reduce(found, axis=1) >= np.log(run_length))
    return int(crossed[0]) if crossed.size else None


def test_a_small_change_after_many_normal_windows_is_found_though_few_slots_were_learned_from():
    """All windows before the change tell what normal is; 40 slots alone do not tell .4 from .5."""
    parts = [(200, [0.2, 0.4, 0.4, 0.0]), (200, [0.2, 0.5, 0.3, 0.0])]
    alarms = [alarm_of(40, parts, seed) for seed in range(12)]
    found = [alarm for alarm in alarms if alarm is not None]
    assert len(found) >= 10
    assert min(found) >= 200


@pytest.mark.study
def test_false_alarms_of_networks_from_the_learned_law_are_as_rare_as_said():
    """At most windows / run length of logs have one (Doob); 3 standard errors."""
    random, count, slots, run_length = np.random.default_rng(0), 100, 40, 400
    alarms = 0
    for seed in range(400):
        chances = random.dirichlet(FRESH[0])
        alarms += alarm_of(slots, [(count, chances)], 1000 + seed, run_length) is not None
    bound = count / run_length
    assert alarms / 400 < bound + 3 * np.sqrt(bound * (1 - bound) / 400)


def test_a_small_change_that_lasts_is_found_by_all_windows_together():
    found = evidence_since(FRESH, 10 * LEARNED, windows(100, [0.25, 0.48, 0.25, 0.02]))
    assert found[-1].max() > np.log(1000)
    assert statistics.detector(found[:, 0]).max() < np.log(
        1000
    )  # each window by itself pays for a law of its own


def test_nothing_is_gathered_where_nothing_changed():
    found = evidence_since(FRESH, LEARNED, windows(40, [0.35, 0.3, 0.34, 0.01]))
    assert np.logaddexp.reduce(found, axis=1).max() < np.log(1000)
