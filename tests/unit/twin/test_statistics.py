"""Statistics of a monitor: closed forms, the bound on false alarms, run lengths of the detector."""

import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.twin import statistics
from dtprob.twin.likelihood import table_likelihoods


def test_statistics_of_known_likelihoods():
    likelihood = np.log(np.array([[0.5, 0.1], [0.25, 0.3]]))
    np.testing.assert_allclose(np.exp(statistics.log_predictive(likelihood)), [0.375, 0.2])
    np.testing.assert_allclose(statistics.disagreement(likelihood), [np.log(2) / 2, np.log(3) / 2])
    evidence = statistics.log_evidence(np.log(np.array([[0.3, 0.4]])), likelihood)
    np.testing.assert_allclose(np.exp(evidence), [0.8, 2.0])


def test_false_alarms_are_at_most_the_rate():
    rng = np.random.default_rng(0)
    rate, alarms, trials = 0.1, 0, 4000
    for _ in range(trials):
        normal, new = rng.poisson(2.0, 30), rng.poisson(2.0)
        alarms += new > statistics.threshold(normal, rate)
    assert alarms / trials < rate + 4 * np.sqrt(rate * (1 - rate) / trials)
    continuous = np.mean(
        [rng.normal() > statistics.threshold(rng.normal(size=29), rate) for _ in range(trials)]
    )
    assert abs(continuous - 0.1) < 4 * np.sqrt(rate * (1 - rate) / trials)


def test_p_values_reach_the_rate_where_the_threshold_alarms():
    normal = np.arange(19.0)
    new = np.array([-1.0, 9.0, 17.5, 18.5])
    alarm = new > statistics.threshold(normal, 0.05)
    assert np.array_equal(alarm, statistics.p_value(new, normal) <= 0.05)


def test_too_few_normal_windows_are_refused():
    with pytest.raises(InputError, match="19 or more, got 18"):
        statistics.threshold(np.arange(18.0), 0.05)
    with pytest.raises(InputError, match="NaN in 1 of 30"):
        statistics.threshold(np.array([*np.arange(29.0), np.nan]), 0.05)
    with pytest.raises(InputError, match="between 0 and 1"):
        statistics.threshold(np.arange(18.0), 1.5)


def test_the_detectors_run_length_holds_and_changes_are_found():
    rng = np.random.default_rng(1)
    shift, target, length = 1.0, 200.0, 3000
    normal = rng.normal(size=(300, length))
    path = statistics.detector(shift * normal - shift**2 / 2)
    crossed = path >= np.log(target)
    first = np.where(crossed.any(axis=1), crossed.argmax(axis=1), length)
    assert first.mean() + 1 > target
    changed = rng.normal(shift, size=(300, 100))
    delay = (statistics.detector(shift * changed - shift**2 / 2) >= np.log(target)).argmax(axis=1) + 1
    assert delay.mean() < 3 * np.log(target) / (shift**2 / 2) / 2
    steps = np.log([2.0, 0.5])
    np.testing.assert_allclose(np.exp(statistics.detector(steps)), [2.0, 1.5])


def test_roc_and_its_area():
    normal, changed = np.array([0.5, 0.5, 0.0]), np.array([0.0, 0.5, 0.5])
    assert statistics.area(np.array([0.0, 1.0, 2.0]), normal, changed) == pytest.approx(0.875)
    false, true = statistics.roc(np.array([0.0, 1.0, 2.0]), normal, changed)
    np.testing.assert_allclose(false, [0, 0, 0.5, 1])
    np.testing.assert_allclose(true, [0, 0.5, 1, 1])
    assert statistics.area(np.zeros(3), normal, changed) == pytest.approx(0.5)


def test_likelihood_of_counts_with_what_cannot_happen():
    tables = np.log(np.array([[0.5, 0.5], [1.0, 1e-300]]))
    tables[1, 1] = -np.inf
    counts = np.array([[2.0, 0.0], [1.0, 1.0]])
    found = table_likelihoods({"t": counts}, {"t": tables})["t"]
    np.testing.assert_allclose(found, [[np.log(0.25), np.log(0.25)], [0.0, -np.inf]])


def test_windows_that_cannot_be_are_changes():
    """Two draws allow the first window, one the second, none the third."""
    learned = np.log(
        np.array([[0.2, 0.1, 0.0], [0.4, 0.0, 0.0]]),
        where=[[1, 1, 0], [1, 0, 0]],
        out=np.full((2, 3), -np.inf),
    )
    np.testing.assert_allclose(statistics.disagreement(learned), [np.log(2) / 2, np.inf, np.inf])
    changed = np.log(np.full((2, 3), 0.15))
    np.testing.assert_allclose(statistics.log_evidence(changed, learned), [np.log(0.5), np.log(3), np.inf])
    nothing = np.full((2, 3), -np.inf)
    np.testing.assert_array_equal(statistics.log_evidence(nothing, learned), [-np.inf, -np.inf, np.inf])


def test_a_certain_change_stays_certain():
    """Whatever comes after a window that cannot be without a change, also one that cannot be with it."""
    evidence = np.array([[0.1, np.inf, -np.inf, 0.3], [0.1, -np.inf, 0.0, np.log(2)]])
    expected = [[0.1, np.inf, np.inf, np.inf], [0.1, -np.inf, 0.0, np.log(4)]]
    np.testing.assert_allclose(statistics.detector(evidence), expected)


def test_a_factor_that_changed_for_sure_is_the_one_that_is_blamed():
    """Its evidence has no bound in a window that cannot be under what was learned."""
    evidence = {"arrivals": np.array([0.3, -1.0]), "reception": np.array([0.1, np.inf])}
    assert statistics.blame(evidence) == {"arrivals": 0.0, "reception": 1.0}
    assert statistics.shares({"a": np.inf, "b": np.inf, "c": 0.0}) == {"a": 0.5, "b": 0.5, "c": 0.0}
    assert statistics.shares({"a": -np.inf, "b": -np.inf}) == {"a": 0.5, "b": 0.5}
    assert statistics.shares({}) == {}
