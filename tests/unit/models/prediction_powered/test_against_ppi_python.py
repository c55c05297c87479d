"""Agreement with ppi-python (0.2.3, called in the same run) wherever it has the same estimator."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.quantile import Quantile
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.tuning import PUBLISHED
from tests.unit.models.prediction_powered.examples import linear, scalar

ESTIMATES = replace(PUBLISHED, form="estimates")
TIGHT = {"ftol": 1e-15, "gtol": 1e-12}


@pytest.fixture(scope="module")
def rival():
    with warnings.catch_warnings():  # it silences all warnings of the process when imported
        warnings.simplefilter("ignore")
        import ppi_py

        yield ppi_py


def one_predictor(sample):
    fields = ("x", "y", "prediction", "x_unlabelled")
    values = {name: getattr(sample, name) for name in fields}
    return Sample(**values, prediction_unlabelled=sample.prediction_unlabelled[:, 0])


@pytest.mark.parametrize("lam", [None, 0.6, 1.0])
def test_mean(rival, lam):
    sample = scalar(folds=1)
    y, f, unlabelled = sample.y, sample.prediction, sample.prediction_unlabelled[:, 0]
    found = estimate("mean", sample, "tuned_ppi", lam=lam, practice=PUBLISHED)
    point = rival.ppi_mean_pointestimate(y, f, unlabelled, lam=lam)
    np.testing.assert_allclose(found.theta, np.ravel(point), rtol=1e-9)
    interval = np.ravel(rival.ppi_mean_ci(y, f, unlabelled, alpha=0.1, lam=lam))
    # ppi-python divides the variances by n, dtprob by n - 1.
    np.testing.assert_allclose([found.low[0], found.high[0]], interval, atol=0.02 * np.ptp(interval))


@pytest.mark.parametrize(
    "loss", ["ols", *(pytest.param(name, marks=pytest.mark.study) for name in ("logistic", "poisson"))]
)
@pytest.mark.parametrize("lam", [None, pytest.param(1.0, marks=pytest.mark.study)])
def test_regression(rival, loss, lam):
    sample = one_predictor(linear(n=120, kind=loss))
    practice = ESTIMATES if loss == "ols" else PUBLISHED
    found = estimate(loss, sample, "tuned_ppi", lam=lam, practice=practice)
    x, y, f = sample.x, sample.y, sample.prediction
    options = {} if loss == "ols" else {"optimizer_options": dict(TIGHT)}
    other = sample.x_unlabelled, sample.prediction_unlabelled
    point = getattr(rival, f"ppi_{loss}_pointestimate")(x, y, f, *other, lam=lam, **options)
    np.testing.assert_allclose(found.theta, point, atol=1e-6)
    ends = getattr(rival, f"ppi_{loss}_ci")(x, y, f, *other, alpha=0.1, lam=lam, **options)
    np.testing.assert_allclose(found.low, ends[0], atol=0.02)
    np.testing.assert_allclose(found.high, ends[1], atol=0.02)


def test_cross_mean(rival):
    sample = scalar()
    found = estimate("mean", sample, "cppi", practice=PUBLISHED)
    point = rival.crossppi_mean_pointestimate(sample.y, sample.prediction, sample.prediction_unlabelled)
    np.testing.assert_allclose(found.theta, np.ravel(point), rtol=1e-12)


@pytest.mark.parametrize("loss", ["ols", "logistic"])
def test_cross_regression(rival, loss):
    sample = linear(n=120, kind=loss)
    found = estimate(loss, sample, "cppi", practice=ESTIMATES if loss == "ols" else PUBLISHED)
    data = sample.x, sample.y, sample.prediction, sample.x_unlabelled, sample.prediction_unlabelled
    options = {} if loss == "ols" else {"optimizer_options": dict(TIGHT)}
    point = getattr(rival, f"crossppi_{loss}_pointestimate")(*data, **options)
    np.testing.assert_allclose(found.theta, point, atol=1e-6)
    ends = getattr(rival, f"crossppi_{loss}_ci")(*data, alpha=0.1, **options)
    np.testing.assert_allclose(found.low, ends[0], atol=0.02)
    np.testing.assert_allclose(found.high, ends[1], atol=0.02)


def loss_of(level, y, f, unlabelled):
    """The corrected check loss, as a function of theta."""

    def mean(theta, values):
        return np.mean((level - (values <= theta)) * (values - theta))

    return lambda theta: mean(theta, y) - mean(theta, f) + mean(theta, unlabelled)


# ppi-python's quantile is the value at which the distribution function is nearest the level, dtprob's the minimiser.
@pytest.mark.parametrize("level", [0.2, 0.5, 0.73])
def test_quantile(rival, level):
    sample = scalar(folds=1)
    data = sample.y, sample.prediction, sample.prediction_unlabelled[:, 0]
    found = estimate(Quantile(level), sample, "ppi", practice=PUBLISHED)
    loss = loss_of(level, *data)
    point = float(np.ravel(rival.ppi_quantile_pointestimate(*data, level, exact_grid=True))[0])
    assert loss(found.theta[0]) <= loss(point) + 1e-9
    low, high = np.ravel(rival.ppi_quantile_ci(*data, level, alpha=0.1, exact_grid=True))
    assert low <= found.theta[0] <= high
    assert found.low[0] == pytest.approx(low, abs=1e-6)
    # The function keeps its value up to the next sample, which ends the interval; ppi-python ends it before.
    value = np.unique(np.concatenate(data))
    assert found.high[0] == value[np.argmin(np.abs(value - high)) + 1]


def test_cross_quantile(rival):
    sample = scalar()
    data = sample.y, sample.prediction, sample.prediction_unlabelled
    found = estimate(Quantile(0.5), sample, "cppi")
    loss = loss_of(0.5, *data)
    point = float(np.ravel(rival.crossppi_quantile_pointestimate(*data, 0.5, exact_grid=True))[0])
    assert loss(found.theta[0]) <= loss(point) + 1e-9
    assert found.low[0] <= point <= found.high[0]
