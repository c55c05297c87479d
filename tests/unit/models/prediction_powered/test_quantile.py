"""Quantiles: the minimiser of the corrected check loss, and the interval of what is not rejected."""

import jax
import numpy as np
import pytest

from dtprob.models.prediction_powered.bootstrap import bootstrap_draws
from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.quantile import Quantile
from dtprob.models.prediction_powered.sample import Sample
from tests.unit.models.prediction_powered.examples import scalar

LEVELS = [0.1, 0.5, 0.8]


@pytest.mark.parametrize("n", [1, 2, 3, 5, 10, 21])
@pytest.mark.parametrize("level", LEVELS)
def test_labels_alone_give_their_own_quantile(n, level):
    y = np.random.default_rng(n).permutation(np.arange(1.0, n + 1))
    found = estimate(Quantile(level), Sample(y=y), "erm")
    assert found.theta == [np.quantile(y, level, method="inverted_cdf")]


def weighted(sample):
    random = np.random.default_rng(4)
    weight, other = random.exponential(size=sample.n), random.exponential(size=sample.n_unlabelled)
    return Sample(
        y=sample.y,
        prediction=sample.prediction,
        prediction_unlabelled=sample.prediction_unlabelled,
        weight=weight,
        weight_unlabelled=other,
    )


def corrected_loss(theta, level, sample, mix):
    """The corrected check loss at each theta, written out."""
    true, unlabelled, predicted = mix

    def mean(values, weight):
        loss = (level - (values <= theta[:, None])) * (values - theta[:, None])
        return loss @ (weight / weight.sum())

    ones = np.ones(sample.n_unlabelled)
    other = ones if sample.weight_unlabelled is None else sample.weight_unlabelled
    pairs = [mean(column, other) for column in sample.prediction_unlabelled.T]
    own = true * mean(sample.y, sample.labelled_weight)
    return (
        own
        + unlabelled * np.mean(pairs, axis=0)
        - predicted * mean(sample.prediction, sample.labelled_weight)
    )


@pytest.mark.parametrize("scheme", ["erm", "ss", "cppi", "tuned_cppi"])
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("change", [lambda sample: sample, weighted], ids=["alike", "weighted"])
def test_no_value_has_a_smaller_corrected_loss(scheme, level, change):
    sample = change(scalar(n=31, count=150, folds=3))
    found = estimate(Quantile(level), sample, scheme)
    lam, share = float(found.lam.value[0, 0]), 150 / 181
    mix = (1 - share, share, 0.0) if scheme == "ss" else (1.0, lam, lam)
    every = (sample.y, sample.prediction, sample.prediction_unlabelled.ravel())
    value = np.unique(np.concatenate(every))
    loss = corrected_loss(value, level, sample, mix)
    assert corrected_loss(found.theta, level, sample, mix)[0] == pytest.approx(loss.min(), abs=1e-12)


def test_predictions_keep_their_precision():
    sample = scalar(n=41)
    moved = Sample(
        y=sample.y + 1e9,
        prediction=sample.prediction + 1e9,
        prediction_unlabelled=sample.prediction_unlabelled + 1e9,
    )
    with jax.enable_x64(False):
        found, there = (estimate(Quantile(0.5), one) for one in (sample, moved))
    for name in ("theta", "low", "high"):
        np.testing.assert_allclose(getattr(there, name) - 1e9, getattr(found, name), atol=1e-5)


def test_the_interval_ends_where_rejection_begins():
    # k of 20 labels at or below theta reject the median unless 7 <= k <= 13, and there are 13 up to the 14th.
    found = estimate(Quantile(0.5), Sample(y=np.arange(1.0, 21.0)), "erm")
    assert (found.low[0], found.theta[0], found.high[0]) == (7.0, 10.0, 14.0)


def test_intervals_of_few_labels_cover():
    labels = np.random.default_rng(11).normal(size=(1000, 20))
    found = [estimate(Quantile(0.5), Sample(y=y), "erm") for y in labels]
    covered = np.mean([one.low[0] <= 0 <= one.high[0] for one in found])
    # The chance of 7 to 13 heads of 20 is .885; over 1000 runs its standard error is .01.
    assert covered == pytest.approx(0.885, abs=0.03)


@pytest.mark.parametrize("scheme", ["erm", "cppi", "tuned_cppi"])
def test_resamples_lie_about_the_estimate(scheme):
    sample = scalar(n=41)
    found = estimate(Quantile(0.2), sample, scheme)
    draws = bootstrap_draws(jax.random.key(9), Quantile(0.2), sample, found, 2000)[:, 0]
    assert 0.4 < np.mean(draws < found.theta) + np.mean(draws == found.theta) / 2 < 0.6


@pytest.mark.parametrize(("level", "n", "is_few"), [(0.9, 49, True), (0.9, 51, False), (0.02, 200, True)])
def test_an_extreme_quantile_of_few_labels_has_a_note(level, n, is_few):
    """Beyond the .99 quantile, for one, 82% of all samples of 20 labels have none, so that no interval reaches it."""
    sample = Sample(y=np.random.default_rng(0).normal(size=n))
    notes = estimate(Quantile(level), sample, "erm").notes
    assert [note for note in notes if f"beyond the quantile {level}" in note] == list(notes)
    assert len(notes) == is_few
