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


@pytest.mark.parametrize("loss", ["ols", "logistic", "poisson"])
@pytest.mark.parametrize("lam", [None, 1.0])
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


# Sizes without a common factor, so that no two values are equally near the level.
SIZES = {"n": 41, "count": 307}


@pytest.mark.parametrize("level", [0.2, 0.5, 0.73])
def test_quantile(rival, level):
    sample = scalar(**SIZES, folds=1)
    y, f, unlabelled = sample.y, sample.prediction, sample.prediction_unlabelled[:, 0]
    found = estimate(Quantile(level), sample, "ppi", practice=PUBLISHED)
    point = rival.ppi_quantile_pointestimate(y, f, unlabelled, level, exact_grid=True)
    assert found.theta[0] == pytest.approx(float(np.ravel(point)[0]), abs=1e-6)
    interval = np.ravel(rival.ppi_quantile_ci(y, f, unlabelled, level, alpha=0.1, exact_grid=True))
    np.testing.assert_allclose([found.low[0], found.high[0]], interval, atol=1e-6)


def test_cross_quantile(rival):
    sample = scalar(**SIZES)
    data = sample.y, sample.prediction, sample.prediction_unlabelled
    found = estimate(Quantile(0.5), sample, "cppi")
    point = rival.crossppi_quantile_pointestimate(*data, 0.5, exact_grid=True)
    assert found.theta[0] == pytest.approx(float(np.ravel(point)[0]), abs=1e-6)
