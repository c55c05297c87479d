"""The generalised posterior: it runs under engines, lies at the estimate and is as wide as the sandwich."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.inference import fit
from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.generalised import posterior_data, prediction_powered
from tests.unit.models.prediction_powered.examples import linear

KEY = jax.random.key(3)
ENGINES = {"laplace": {"draws": 4000}, "nuts": {"draws": 1500, "warmup": 300, "chains": 1}}


@pytest.fixture(scope="module")
def case():
    sample = linear(n=100, kind="logistic")
    return sample, estimate("logistic", sample, "tuned_cppi")


@pytest.mark.parametrize("engine", ["laplace", pytest.param("nuts", marks=pytest.mark.study)])
def test_intervals_agree_with_the_sandwich(engine):
    # With 100 labels the posterior is skewed by a quarter of the interval, with 1000 it is normal.
    sample = linear(n=1000, count=5000, kind="logistic")
    found = estimate("logistic", sample, "tuned_cppi")
    data = posterior_data("logistic", sample, found)
    posterior = fit(prediction_powered, data, engine=engine, key=KEY, **ENGINES[engine])
    theta = np.asarray(posterior.draws["theta"]).reshape(-1, 3)
    low, high = np.quantile(theta, [0.05, 0.95], axis=0)
    half = (found.high - found.low) / 2
    # The ends of an interval from 1500 draws are known to about 5% of its half width.
    np.testing.assert_allclose((low - found.low) / half, 0, atol=0.2)
    np.testing.assert_allclose((high - found.high) / half, 0, atol=0.2)


@pytest.mark.study
@pytest.mark.parametrize("calibration", ["matrix", "scalar"])
def test_the_mode_and_the_width_are_calibrated(case, calibration):
    sample, found = case
    data = posterior_data("logistic", sample, found, calibration=calibration, prior_scale=1e6)
    labels = data["y"]

    def energy(theta):
        point = data["minimiser"] + data["turn"] @ (theta - data["center"])
        labelled = data["weight"] @ data["loss"].values(point, data["x"], labels)
        return labelled + data["strength"] * data["correction"](data["loss"], point)

    center = jnp.asarray(found.theta)
    np.testing.assert_allclose(jax.grad(energy)(center) * found.standard_error, 0, atol=1e-5)
    covariance = np.linalg.inv(jax.hessian(energy)(center))
    # Widened from the normal's to Student's quantile, which at these degrees of freedom is 1% to 2%.
    if calibration == "matrix":
        np.testing.assert_allclose(covariance, found.covariance, rtol=0.06, atol=1e-4)
    assert np.trace(covariance) == pytest.approx(np.trace(found.covariance), rel=0.06)


def test_without_calibration_the_width_is_the_loss_own(case):
    sample, found = case
    plain = posterior_data("logistic", sample, found, calibration="none")
    np.testing.assert_array_equal(plain["turn"], np.eye(3))
    assert float(plain["strength"]) == sample.n


def test_unknown_calibration(case):
    sample, found = case
    with pytest.raises(InputError, match="calibration: expected matrix, scalar or none, got 'full'"):
        posterior_data("logistic", sample, found, calibration="full")


def test_labels_cannot_be_drawn_from_a_loss(case):
    sample, found = case
    data = posterior_data("logistic", sample, found)
    with pytest.raises(InputError, match="labels under a loss"):
        fit(prediction_powered, {**data, "y": None}, engine="laplace", key=KEY)
