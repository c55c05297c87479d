"""What a sample makes of the arrays that it is given."""

import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.losses import CustomLoss
from dtprob.models.prediction_powered.quantile import Quantile
from dtprob.models.prediction_powered.sample import Sample


def yes_or_no(kind, folds=5):
    """Labels 0 and 1 with predictions of a type that are right nine times in ten."""
    random = np.random.default_rng(2)
    y = random.random(450) < 0.6
    guess = np.where(random.random((450, folds)) < 0.9, y[:, None], ~y[:, None])
    return Sample(
        y=y[:50], prediction=guess[:50, 0].astype(kind), prediction_unlabelled=guess[50:].astype(kind)
    )


@pytest.mark.parametrize("kind", ["int8", "uint8", "int64", "bool", "float16"])
@pytest.mark.parametrize("loss", ["mean", Quantile(0.3)])
def test_whole_numbers_and_yes_or_no_predict_as_numbers_do(kind, loss):
    found, expected = (estimate(loss, yes_or_no(one), "cppi") for one in (kind, float))
    np.testing.assert_allclose(found.theta, expected.theta, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-6)


def test_unlabelled_features_may_be_whole_numbers():
    random = np.random.default_rng(3)
    x, y = random.integers(0, 9, (60, 2)).astype("uint8"), random.normal(size=60)
    fields = {"x": x[:20], "y": y[:20], "prediction": y[:20] / 2}
    whole, real = (
        Sample(
            **fields, x_unlabelled=x[20:].astype(kind), prediction_unlabelled=lambda rows: rows[:, 0] / 9.0
        )
        for kind in ("uint8", float)
    )
    assert next(whole.blocks()).x.dtype.kind == "f"
    np.testing.assert_allclose(*(estimate("ols", one, "cppi").theta for one in (whole, real)), rtol=1e-6)


def test_predictions_that_are_no_numbers_are_refused():
    sample = Sample(y=np.arange(3.0), prediction=np.arange(3.0), prediction_unlabelled=np.array(["a", "b"]))
    with pytest.raises(InputError, match="prediction_unlabelled: expected real numbers"):
        estimate("mean", sample, "cppi")


def test_what_fills_a_chunk_is_within_the_domain_of_the_loss():
    y = np.random.default_rng(5).lognormal(size=120)
    fields = {"y": y[:20], "prediction": 0.9 * y[:20], "prediction_unlabelled": 0.9 * y[20:]}
    loss = CustomLoss(lambda theta, x, y: 0.5 * (theta[0] - jnp.log(y)) ** 2, jnp.zeros(1))
    whole, chunked = (estimate(loss, Sample(**fields, chunk=chunk), "cppi") for chunk in (None, 64))
    np.testing.assert_allclose(chunked.theta, whole.theta, rtol=1e-10)
    np.testing.assert_allclose(chunked.covariance, whole.covariance, rtol=1e-10)
    np.testing.assert_allclose(whole.theta, np.log(y[20:]).mean(), rtol=1e-10)  # the factor .9 cancels


def test_unlabelled_data_may_be_lists():
    random = np.random.default_rng(4)
    x, y, rest = random.normal(size=(30, 1)), random.normal(size=30), random.normal(size=(90, 1))
    plain = Sample(x=x, y=y, prediction=y / 2, x_unlabelled=rest, prediction_unlabelled=rest[:, 0])
    listed = Sample(
        x=x, y=y, prediction=y / 2, x_unlabelled=rest.tolist(), prediction_unlabelled=rest[:, 0].tolist()
    )
    found, expected = (estimate("ols", sample, "ppi") for sample in (listed, plain))
    np.testing.assert_array_equal(found.theta, expected.theta)
