"""Every wrong input gives one line that says what to do."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from dtprob.errors import InputError
from dtprob.models.prediction_powered.bootstrap import bootstrap
from dtprob.models.prediction_powered.diagnostics import bias_map
from dtprob.models.prediction_powered.estimate import estimate
from dtprob.models.prediction_powered.generalised import posterior_data
from dtprob.models.prediction_powered.losses import SmoothQuantile
from dtprob.models.prediction_powered.predictors import Ridge
from dtprob.models.prediction_powered.quantile import Quantile
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.training import train
from tests.unit.models.prediction_powered.examples import linear, scalar

KEY = jax.random.key(0)
X, Y = np.arange(12.0).reshape(6, 2), np.arange(6.0)
NAN = np.where(np.arange(6) == 2, np.nan, Y)
SAMPLES = {
    "no labels": ({"y": np.zeros(0)}, "y: expected labels"),
    "NaN label": ({"y": NAN}, r"y: expected finite numbers, got nan at index 2\. Move samples without"),
    "text": ({"y": np.array(["a"] * 6)}, "y: expected real numbers"),
    "NaN feature": ({"y": Y, "x": NAN[:, None]}, r"x: expected finite numbers, got nan at index \(2, 0\)"),
    "rows of x": ({"y": Y, "x": X[:4]}, r"x: expected shape \(6, feature\)"),
    "prediction": ({"y": Y, "prediction": Y[:3]}, r"prediction: expected shape \(6,\), got \(3,\)"),
    "width": (
        {"y": Y, "x": X, "x_unlabelled": np.zeros((4, 3))},
        "x_unlabelled: expected width 2, as x has, got width 3",
    ),
    "predictors first": (
        {"y": Y, "prediction": Y, "prediction_unlabelled": np.zeros((5, 40))},
        r"expected axes \(sample, predictor\), .*got 40 predictors of 5 samples\. Transpose it",
    ),
    "more predictors than labels": (
        {"y": Y, "prediction": Y, "prediction_unlabelled": np.zeros((40, 7))},
        "of 6 labels no more than 6 predictors, got 7 predictors of 40 samples",
    ),
    "no own predictions": ({"y": Y, "prediction_unlabelled": Y}, "prediction: expected predictions of the"),
    "masked label": (
        {"y": np.ma.masked_array(Y, mask=Y > 3)},
        "y: expected values that are there, got a masked one in row 4. Move samples without",
    ),
    "masked predictions": (
        {"y": Y, "prediction": Y, "prediction_unlabelled": np.ma.masked_array(Y, mask=Y > 3)},
        "prediction_unlabelled: expected values that are there, got a masked one in row 4. Remove",
    ),
    "columns in another order": (
        {
            "y": Y,
            "x": pd.DataFrame(X, columns=["a", "b"]),
            "x_unlabelled": pd.DataFrame(X, columns=["b", "a"]),
        },
        r"x_unlabelled: expected columns \['a', 'b'\], as x has, got \['b', 'a'\]",
    ),
    "one unlabelled sample": (
        {"y": Y, "prediction": Y, "prediction_unlabelled": Y[:1]},
        "prediction_unlabelled: expected 2 or more samples, got 1. Give more, or leave it out",
    ),
    "empty chunks": ({"y": Y, "chunk": 0}, "chunk: expected 1 or more rows, got 0"),
    "negative weight": ({"y": Y, "weight": -Y}, r"weight: expected weights from 0 up, got -1 at index 1"),
    "no weight": ({"y": Y, "weight": 0 * Y}, "weight: expected a weight above 0"),
    "context": ({"y": Y, "context": Y}, "context: expected shape"),
    "strange context": (
        {
            "y": Y,
            "prediction": Y,
            "prediction_unlabelled": Y,
            "context": np.zeros(6, int),
            "context_unlabelled": np.full(6, 2),
        },
        "context_unlabelled: expected contexts below 1",
    ),
}
CALLS = {
    "scheme": (lambda: estimate("mean", scalar(), "tuned-cppi"), r"Did you mean 'tuned_cppi'\?"),
    "loss": (
        lambda: estimate("logistc", linear()),
        r"one of the losses logistic, .*Did you mean 'logistic'\?",
    ),
    "classes -1 and 1": (
        lambda: estimate("logistic", Sample(x=X, y=np.sign(Y - 2.5)), "erm"),
        "y with loss logistic: expected labels 0 and 1, got -1. Correct y, or use mean, ols, poisson",
    ),
    "negative counts": (
        lambda: estimate("poisson", Sample(x=X, y=Y - 1), "erm"),
        "y with loss poisson: expected labels from 0 up, got -1",
    ),
    "no loss": (lambda: estimate(lambda t, x, y: t, linear()), "Wrap a function in CustomLoss"),
    "level": (lambda: estimate("mean", scalar(), level=90), "level: expected a number between 0 and 1"),
    "lambda": (lambda: estimate("mean", scalar(), lam=2), "lam: expected a number from 0 to 1"),
    "lambda of ss": (lambda: estimate("mean", scalar(), "ss", lam=0.5), "lam: expected nothing"),
    "dependent": (
        lambda: estimate("ols", Sample(x=np.ones((6, 2)), y=Y), "erm"),
        "features: expected independent columns",
    ),
    "separable": (
        lambda: estimate("logistic", Sample(x=Y[:, None] - 2.5, y=(Y > 2).astype(float)), "erm"),
        "corrected loss: expected a minimum",
    ),
    "quantile level": (lambda: Quantile(1.0), "quantile: expected a level between 0 and 1"),
    "quantile of vectors": (lambda: estimate(Quantile(0.5), Sample(y=X), "erm"), "y: expected labels of one"),
    "smooth quantile of vectors": (
        lambda: estimate(SmoothQuantile(0.5, jnp.asarray(0.3)), Sample(y=X), "erm"),
        "y: expected labels of one number, for a quantile",
    ),
    "regression of a column": (
        lambda: estimate("ols", Sample(x=X, y=Y[:, None]), "erm"),
        r"y: expected labels of one number, for a regression, got shape \(6, 1\)\. Take .* y\[:, 0\]",
    ),
    "regression on nothing": (
        lambda: estimate("logistic", Sample(y=Y > 2), "erm"),
        "x: expected features, for a regression, got none",
    ),
    "by nothing that there is": (
        lambda: estimate(Quantile(0.5), scalar(), by="nonsense"),
        "by: expected one of the choices context, overall, parameter, got 'nonsense'",
    ),
    "quantile by context": (
        lambda: estimate(Quantile(0.5), scalar(), by="context"),
        "by: expected overall, for a quantile, got 'context'",
    ),
    "posterior of a quantile": (
        lambda: posterior_data(Quantile(0.5), scalar(), estimate(Quantile(0.5), scalar())),
        "loss: expected one with a second derivative",
    ),
    "few draws": (
        lambda: bootstrap(KEY, "mean", scalar(), estimate("mean", scalar()), draws=1),
        "bootstrap: expected 2 or more draws",
    ),
    "no map": (lambda: bias_map(Sample(x=X, y=Y)), "bias map: expected scalar labels with predictions"),
    "few labels": (
        lambda: train(KEY, "cppi", Ridge(), x=X, y=Y, x_unlabelled=X, folds=7),
        r"labelled samples: expected at least one per fold \(7\), got 6\. Use 6 folds",
    ),
    "masked label of a training": (
        lambda: train(KEY, "cppi", Ridge(), x=X, y=np.ma.masked_array(Y, mask=Y > 3), x_unlabelled=X),
        "y: expected values that are there, got a masked one in row 4",
    ),
    "one fold": (
        lambda: train(KEY, "cppi", Ridge(), x=X, y=Y, x_unlabelled=X, folds=1),
        "folds: expected 2 or more",
    ),
    "one class": (
        lambda: train(KEY, "cppi", Ridge(), x=X, y=(Y == 0) * 1.0, x_unlabelled=X, folds=2, probability=True),
        "training labels of fold .: expected both classes, got only 0",
    ),
    "no predictor": (
        lambda: train(KEY, "ppi", 3, x=X, y=Y, x_unlabelled=X),
        "predictor: expected methods fit and predict",
    ),
    "unlabelled NaN of a quantile": (
        lambda: estimate(
            Quantile(0.5),
            Sample(y=Y, prediction=Y, prediction_unlabelled=np.where(Y == 4, np.nan, Y)),
            "ppi",
        ),
        "prediction_unlabelled: expected finite numbers, got NaN or infinity at sample 4",
    ),
    "unlabelled NaN": (
        lambda: estimate(
            "mean", Sample(y=Y, prediction=Y, prediction_unlabelled=np.where(Y == 4, np.nan, Y)), "ppi"
        ),
        "prediction_unlabelled: expected finite numbers, got NaN or infinity at sample 4",
    ),
}


def one_line(function, text):
    with pytest.raises(InputError, match=text) as caught:
        function()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", SAMPLES)
def test_samples(name):
    fields, text = SAMPLES[name]
    one_line(lambda: Sample(**fields), text)


@pytest.mark.parametrize("name", CALLS)
def test_calls(name):
    one_line(*CALLS[name])
