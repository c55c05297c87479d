"""Least squares for labels of many entries, against the estimators for one entry."""

import numpy as np
import pytest

from dtprob.models.prediction_powered.multioutput import Labelled, Unlabelled, left_out, regress
from dtprob.models.prediction_powered.schemes import SCHEMES
from tests.unit.models.prediction_powered.examples import linear, scalar


def groups(sample, x, x_unlabelled):
    average = sample.prediction_unlabelled.mean(axis=1)
    columns = [values[:, None] for values in (sample.y, sample.prediction, average)]
    return Labelled(x, columns[0], columns[1]), Unlabelled.of(x_unlabelled, columns[2])


@pytest.mark.parametrize("scheme", ["erm", "ss", "cppi"])
def test_one_entry_solves_the_corrected_normal_equations(scheme):
    sample = linear()
    labelled, unlabelled = groups(sample, sample.x, sample.x_unlabelled)
    n, count = sample.n, sample.n_unlabelled
    share = count / (n + count)
    true, plus, minus = {"erm": (1, 0, 0), "ss": (1 - share, share, 0), "cppi": (1, 1, 1)}[scheme]
    gram = (true - minus) / n * labelled.x.T @ labelled.x + plus / count * unlabelled.x.T @ unlabelled.x
    moment = labelled.x.T @ (true * labelled.y - minus * labelled.prediction) / n
    moment += plus / count * unlabelled.x.T @ unlabelled.prediction
    found = regress(labelled, unlabelled, SCHEMES[scheme], penalty=0.1)
    np.testing.assert_allclose(found.coefficient, np.linalg.solve(gram + 0.1 * np.eye(3), moment), rtol=1e-8)


def test_a_constant_feature_gives_the_tuned_mean():
    sample = scalar()
    n, count = sample.n, sample.n_unlabelled
    data = groups(sample, np.ones((n, 1)), np.ones((count, 1)))
    found = regress(*data, SCHEMES["tuned_cppi"], penalty=1e-12)
    average = sample.prediction_unlabelled.mean(axis=1)
    covariance = np.cov(sample.y, sample.prediction, ddof=0)
    lam = covariance[0, 1] / (covariance[1, 1] + n / count * average.var())
    assert found.lam == pytest.approx(lam, rel=3 / n)
    # A sample that is left out changes the constant by one part in n, and lambda hardly.
    expected = sample.y.mean() + found.lam * (average.mean() - sample.prediction.mean())
    assert found.coefficient[0, 0] == pytest.approx(expected, rel=1e-8)


def test_one_entry_repeated_keeps_lambda():
    sample = linear(quality=1.5)
    labelled, unlabelled = groups(sample, sample.x, sample.x_unlabelled)
    alone = regress(labelled, unlabelled, SCHEMES["tuned_cppi"], penalty=0.01)
    thrice = regress(
        Labelled(sample.x, np.tile(labelled.y, 3), np.tile(labelled.prediction, 3)),
        unlabelled.predicted(np.tile(unlabelled.prediction, 3)),
        SCHEMES["tuned_cppi"],
        penalty=0.01,
    )
    assert 0 < alone.lam < 1
    assert thrice.lam == pytest.approx(alone.lam, rel=1e-10)
    np.testing.assert_allclose(thrice.coefficient, np.tile(alone.coefficient, 3), rtol=1e-9)


def test_predictions_that_go_against_the_labels_are_not_used():
    sample = linear(quality=-1.0)
    data = groups(sample, sample.x, sample.x_unlabelled)
    found, alone = (regress(*data, SCHEMES[name], penalty=0.01) for name in ("tuned_cppi", "erm"))
    assert found.lam == 0
    np.testing.assert_array_equal(found.coefficient, alone.coefficient)


def test_what_is_left_out_is_what_a_fit_without_the_sample_says():
    sample = linear(quality=1.5)
    labelled, unlabelled = groups(sample, sample.x, sample.x_unlabelled)
    penalty, lam, n = 0.05, 0.4, sample.n
    identity = penalty * np.eye(3)

    def fit(kept):
        x = labelled.x[kept]
        gram = (1 - lam) / n * x.T @ x + lam * unlabelled.second + identity
        own = (labelled.y - lam * labelled.prediction)[kept]
        return np.linalg.solve(gram, x.T @ own / n + lam * unlabelled.moment)

    found = left_out(labelled, unlabelled, fit(np.ones(n, bool)), penalty, lam)
    for i in (0, 7):
        np.testing.assert_allclose(found[i], labelled.x[i] @ fit(np.arange(n) != i), rtol=1e-9)


def test_lambda_is_not_lost_where_features_are_as_many_as_labels():
    """Waves on a line, a predictor better than the fit: of 40 data sets, the error that lambda leaves."""
    errors = []
    for seed in range(40):
        random = np.random.default_rng(seed)
        frequency, phase = 3 * random.standard_normal(60), random.uniform(0, 2 * np.pi, 60)

        def waves(place, frequency=frequency, phase=phase):
            return np.sqrt(2 / 60) * np.cos(np.outer(place, frequency) + phase)

        place, other = random.uniform(-3, 3, 60), random.uniform(-3, 3, 2000)
        noise = [0.5 * random.standard_normal((len(at), 1)) for at in (place, other)]
        y = np.sin(2 * place)[:, None] + noise[0]
        predicted = [0.9 * np.sin(2 * at)[:, None] for at in (place, other)]
        data = Labelled(waves(place), y, predicted[0]), Unlabelled.of(waves(other), predicted[1])
        fits = [regress(*data, SCHEMES[name], penalty=1e-3) for name in ("erm", "tuned_cppi")]
        truth = np.sin(2 * other)[:, None]
        errors.append([np.mean((waves(other) @ fit.coefficient - truth) ** 2) for fit in fits])
    erm, tuned = np.mean(errors, axis=0)
    assert tuned < 0.8 * erm
