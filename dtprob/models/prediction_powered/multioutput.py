"""Penalised least squares for labels of many entries, under each scheme, in closed form.

All entries share the features, so one matrix of second moments serves them all, and a thousand entries cost
little more than one. The corrected loss is that of `schemes`, plus the penalty.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import linalg

from dtprob.models.prediction_powered.schemes import Scheme


class Labelled(NamedTuple):
    """Labelled samples.

    Attributes:
        x: features.
        y: labels.
        prediction: of the labels, by a predictor that saw none of them; equal to y without a predictor.
    """

    x: Float[np.ndarray, "sample feature"]
    y: Float[np.ndarray, "sample entry"]
    prediction: Float[np.ndarray, "sample entry"]


class Unlabelled(NamedTuple):
    """Unlabelled samples; the predictions are averaged over predictors."""

    x: Float[np.ndarray, "sample feature"]
    prediction: Float[np.ndarray, "sample entry"]


class Regression(NamedTuple):
    """A fitted regression.

    Attributes:
        coefficient: the minimiser of the corrected loss.
        lam: weight of the correction.
    """

    coefficient: Float[np.ndarray, "feature entry"]
    lam: float


def regress(
    labelled: Labelled, unlabelled: Unlabelled, scheme: Scheme, *, penalty: float, pilot: float = 0.5
) -> Regression:
    """Minimise the corrected loss of a scheme plus half the penalty times the squared coefficients.

    A tuned scheme's lambda minimises the error of the fitted values, averaged over the population: its
    directions are those of the root of the inverse second derivative, where the error of the coefficients
    would have those of the inverse itself and depend on the features' scales.

    Args:
        labelled: labelled samples.
        unlabelled: unlabelled samples, with zeros for predictions when the scheme uses none.
        scheme: one of the six.
        penalty: on the mean loss, above 0.
        pilot: lambda of the estimate at which lambda is computed.
    """
    n, count = len(labelled.x), len(unlabelled.x)
    if scheme.pooled:
        share = count / (n + count)
        return Regression(_solve(labelled, unlabelled, (1 - share, share, 0.0), penalty), 1.0)
    lam = pilot if scheme.lam is None else scheme.lam
    coefficient = _solve(labelled, unlabelled, (1.0, lam, lam), penalty)
    if scheme.is_tuned:
        lam = tuned_lambda(labelled, unlabelled, coefficient, penalty)
        coefficient = _solve(labelled, unlabelled, (1.0, lam, lam), penalty)
    return Regression(coefficient, lam)


def _solve(
    labelled: Labelled, unlabelled: Unlabelled, mix: tuple[float, float, float], penalty: float
) -> Float[np.ndarray, "feature entry"]:
    """The minimiser with weights of labels, unlabelled predictions and labelled predictions."""
    true, plus, minus = mix
    n, count = len(labelled.x), len(unlabelled.x)
    gram = (true - minus) / n * labelled.x.T @ labelled.x
    moment = labelled.x.T @ (true * labelled.y - minus * labelled.prediction) / n
    if plus:
        gram = gram + plus / count * unlabelled.x.T @ unlabelled.x
        moment = moment + plus / count * unlabelled.x.T @ unlabelled.prediction
    return linalg.solve(gram + penalty * np.eye(len(gram)), moment, assume_a="pos")


def tuned_lambda(
    labelled: Labelled,
    unlabelled: Unlabelled,
    coefficient: Float[np.ndarray, "feature entry"],
    penalty: float,
) -> float:
    """The lambda that minimises the error of the fitted values, in [0, 1].

    A sample's gradient is the product of its features and its residual, so that sums over both factors.
    """
    n, count = len(labelled.x), len(unlabelled.x)
    gram = (labelled.x.T @ labelled.x + unlabelled.x.T @ unlabelled.x) / (n + count)
    root = linalg.cholesky(gram + penalty * np.eye(len(gram)), lower=True)

    def white(x: Float[np.ndarray, "sample feature"]) -> Float[np.ndarray, "sample feature"]:
        return linalg.solve_triangular(root, x.T, lower=True).T

    own, other = white(labelled.x), white(unlabelled.x)
    fitted = labelled.x @ coefficient
    g, f = fitted - labelled.y, fitted - labelled.prediction
    cross = _covariance(own, g, f)
    spread = _covariance(own, f, f)
    rest = unlabelled.x @ coefficient - unlabelled.prediction
    bottom = spread + n / count * _covariance(other, rest, rest)
    return float(np.clip(cross / bottom, 0.0, 1.0)) if bottom > 0 else 0.0


def _covariance(
    x: Float[np.ndarray, "sample feature"],
    first: Float[np.ndarray, "sample entry"],
    second: Float[np.ndarray, "sample entry"],
) -> float:
    """Covariance of the products of features with two residuals, summed over all entries."""
    products = np.mean(np.sum(x**2, axis=1) * np.sum(first * second, axis=1))
    means = x.T @ first / len(x), x.T @ second / len(x)
    return float(products - np.sum(means[0] * means[1]))
