"""Derivatives of every loss against finite differences, and user losses against built-in ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.losses import (
    LOGISTIC,
    MEAN,
    OLS,
    POISSON,
    CustomLoss,
    SmoothQuantile,
)
from tests.unit.models.prediction_powered.examples import linear, scalar


def huber(theta, x, y):
    residual = y - theta["intercept"] - x[1:] @ theta["slope"]
    return jnp.sqrt(1 + residual**2) - 1


HUBER = CustomLoss(huber, {"intercept": jnp.zeros(()), "slope": jnp.zeros(2)})
LOSSES = {
    "mean": (MEAN, 1),
    "ols": (OLS, 3),
    "logistic": (LOGISTIC, 3),
    "poisson": (POISSON, 3),
    "quantile": (SmoothQuantile(0.3, jnp.asarray(0.2)), 1),
    "custom": (HUBER, 3),
}


def differences(function, theta, step=1e-6):
    """Central differences of a function of a vector, the new axis last."""
    moves = step * np.eye(len(theta))
    return np.stack([(function(theta + m) - function(theta - m)) / (2 * step) for m in moves], axis=-1)


@pytest.fixture(params=LOSSES, scope="module")
def case(request):
    loss, dimension = LOSSES[request.param]
    rng = np.random.default_rng(3)
    x, y = jnp.asarray(rng.normal(size=(7, 3))), jnp.asarray(rng.random(7))
    return loss, jnp.asarray(rng.normal(size=dimension)), x, y


def test_gradients_are_the_slopes_of_the_values(case):
    loss, theta, x, y = case
    expected = differences(lambda point: loss.values(point, x, y), theta)
    np.testing.assert_allclose(loss.gradients(theta, x, y), expected, rtol=1e-6, atol=1e-8)


def test_hessian_is_the_slope_of_the_weighted_gradient(case):
    loss, theta, x, y = case
    weight = jnp.arange(7.0) / 3
    expected = differences(lambda point: weight @ loss.gradients(point, x, y), theta)
    np.testing.assert_allclose(loss.hessian(theta, x, y, weight), expected, rtol=1e-6, atol=1e-7)


def test_traits_tell_the_truth(case):
    loss, theta, x, y = case
    weight, other = jnp.ones(7), theta + 0.7
    hessians = [loss.hessian(point, x, labels, weight) for point, labels in ((theta, y), (theta, y + 1))]
    if loss.traits.linear_in_label:
        np.testing.assert_allclose(*hessians, rtol=1e-12)
        halves = [loss.gradients(theta, x, y + shift) for shift in (0.0, 0.5, 1.0)]
        np.testing.assert_allclose(halves[1], (halves[0] + halves[2]) / 2, rtol=1e-12, atol=1e-14)
    if loss.traits.quadratic:
        np.testing.assert_allclose(hessians[0], loss.hessian(other, x, y, weight), rtol=1e-12)
    if loss.traits.translation:
        moved = loss.gradients(other, x, y) - loss.gradients(theta, x, y)
        np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), rtol=1e-12)


@pytest.mark.parametrize("scheme", ["erm", "cppi", "tuned_cppi"])
def test_a_custom_loss_equals_the_built_in_one(scheme):
    sample = linear(kind="logistic")
    own = CustomLoss(lambda theta, x, y: jax.nn.softplus(x @ theta) - y * (x @ theta), jnp.zeros(3))
    found, expected = estimate(own, sample, scheme), estimate("logistic", sample, scheme)
    np.testing.assert_allclose(found.theta, expected.theta, rtol=1e-6)
    # The built-in loss takes its curvature from all samples, the custom one that of the corrected loss.
    np.testing.assert_allclose(found.standard_error, expected.standard_error, rtol=0.25)


def test_a_custom_loss_keeps_the_structure_of_its_parameters():
    found = estimate(HUBER, linear(), "tuned_cppi")
    parameters = HUBER.unravel(jnp.asarray(found.theta))
    assert sorted(parameters) == ["intercept", "slope"]
    assert parameters["slope"].shape == (2,)


def test_the_smooth_quantile_nears_the_quantile():
    sample = scalar(n=400)
    smooth = estimate(SmoothQuantile(0.3, jnp.asarray(0.05)), sample, "erm")
    assert smooth.theta[0] == pytest.approx(np.quantile(sample.y, 0.3), abs=0.05)
