"""Least squares for labels of many entries, against the estimators for one entry."""

import numpy as np
import pytest

from dtprob.models.prediction_powered.multioutput import Labelled, Unlabelled, regress
from dtprob.models.prediction_powered.schemes import SCHEMES
from tests.unit.models.prediction_powered.examples import linear, scalar


def groups(sample, x, x_unlabelled):
    average = sample.prediction_unlabelled.mean(axis=1)
    columns = [values[:, None] for values in (sample.y, sample.prediction, average)]
    return Labelled(x, columns[0], columns[1]), Unlabelled(x_unlabelled, columns[2])


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
    assert found.lam == pytest.approx(lam, rel=1e-8)
    expected = sample.y.mean() + lam * (average.mean() - sample.prediction.mean())
    assert found.coefficient[0, 0] == pytest.approx(expected, rel=1e-8)


def test_one_entry_repeated_keeps_lambda():
    sample = linear(quality=1.5)
    labelled, unlabelled = groups(sample, sample.x, sample.x_unlabelled)
    alone = regress(labelled, unlabelled, SCHEMES["tuned_cppi"], penalty=0.01)
    thrice = regress(
        Labelled(sample.x, np.tile(labelled.y, 3), np.tile(labelled.prediction, 3)),
        Unlabelled(unlabelled.x, np.tile(unlabelled.prediction, 3)),
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
