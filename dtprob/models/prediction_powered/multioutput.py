"""Penalised least squares for labels of many entries, under each scheme, in closed form.

All entries share the features, so one matrix of second moments serves them all, and a thousand entries cost
little more than one. The corrected loss is that of `schemes`, plus the penalty.
"""

from typing import NamedTuple, Self

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
    """Unlabelled samples, with the means that every fit needs; make it by `of`.

    Attributes:
        x: features.
        prediction: of the labels, averaged over predictors.
        second: mean outer product of the features with themselves.
        moment: mean outer product of the features with the predictions.
    """

    x: Float[np.ndarray, "sample feature"]
    prediction: Float[np.ndarray, "sample entry"]
    second: Float[np.ndarray, "feature feature"]
    moment: Float[np.ndarray, "feature entry"]

    @classmethod
    def of(
        cls, x: Float[np.ndarray, "sample feature"], prediction: Float[np.ndarray, "sample entry"]
    ) -> Self:
        """From features and predictions."""
        return cls(x, prediction, x.T @ x / len(x), x.T @ prediction / len(x))

    def predicted(self, prediction: Float[np.ndarray, "sample entry"]) -> Self:
        """The same samples with the predictions of other predictors."""
        return self._replace(prediction=prediction, moment=self.x.T @ prediction / len(self.x))


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
        unlabelled: unlabelled samples; "erm" does not look at their predictions.
        scheme: one of the six.
        penalty: on the mean loss, above 0.
        pilot: lambda of the estimate at which lambda is computed.
    """
    n, count = len(labelled.x), len(unlabelled.x)
    if scheme.pooled:
        share = count / (n + count)
        return Regression(_solve(labelled, unlabelled, (1 - share, share, 0.0), penalty), 1.0)
    lam = tuned_lambda(labelled, unlabelled, penalty, pilot) if scheme.lam is None else scheme.lam
    return Regression(_solve(labelled, unlabelled, (1.0, lam, lam), penalty), lam)


def _solve(
    labelled: Labelled, unlabelled: Unlabelled, mix: tuple[float, float, float], penalty: float
) -> Float[np.ndarray, "feature entry"]:
    """The minimiser with weights of labels, unlabelled predictions and labelled predictions."""
    true, plus, minus = mix
    moment = labelled.x.T @ (true * labelled.y - minus * labelled.prediction) / len(labelled.x)
    gram = _curvature(labelled, unlabelled, mix, penalty)
    return linalg.solve(gram, moment + plus * unlabelled.moment, assume_a="pos")


def _curvature(
    labelled: Labelled, unlabelled: Unlabelled, mix: tuple[float, float, float], penalty: float
) -> Float[np.ndarray, "feature feature"]:
    """The second derivative of the penalised loss."""
    true, plus, minus = mix
    own = (true - minus) / len(labelled.x) * labelled.x.T @ labelled.x
    return own + plus * unlabelled.second + penalty * np.eye(own.shape[0])


def left_out(
    labelled: Labelled,
    unlabelled: Unlabelled,
    coefficient: Float[np.ndarray, "feature entry"],
    penalty: float,
    lam: float,
) -> Float[np.ndarray, "sample entry"]:
    """What is fitted at each labelled sample when its own terms are left out of the corrected loss.

    With as many features as labels the residuals of fitted samples are far too small, and lambda with them.

    Args:
        labelled: labelled samples.
        unlabelled: unlabelled samples.
        coefficient: the fit to all samples.
        penalty: with which it was fitted.
        lam: likewise.
    """
    gram = _curvature(labelled, unlabelled, (1.0, lam, lam), penalty)
    solved = linalg.solve(gram, labelled.x.T, assume_a="pos").T
    leverage = np.einsum("sf,sf->s", labelled.x, solved)[:, None] / len(labelled.x)
    own = labelled.y - lam * labelled.prediction
    return (labelled.x @ coefficient - leverage * own) / (1 - (1 - lam) * leverage)


def tuned_lambda(labelled: Labelled, unlabelled: Unlabelled, penalty: float, pilot: float) -> float:
    """The lambda that minimises the error of the fitted values, in [0, 1].

    A sample's gradient is the product of its features and its residual, so that sums over both factors.

    Args:
        labelled: labelled samples.
        unlabelled: unlabelled samples.
        penalty: on the mean loss.
        pilot: lambda of the fit at which residuals are taken.
    """
    n, count = len(labelled.x), len(unlabelled.x)
    root = linalg.cholesky(unlabelled.second + penalty * np.eye(labelled.x.shape[1]), lower=True)

    def white(x: Float[np.ndarray, "sample feature"]) -> Float[np.ndarray, "sample feature"]:
        return linalg.solve_triangular(root, x.T, lower=True).T

    own, other = white(labelled.x), white(unlabelled.x)
    coefficient = _solve(labelled, unlabelled, (1.0, pilot, pilot), penalty)
    fitted = left_out(labelled, unlabelled, coefficient, penalty, pilot)
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
    products = np.mean(np.einsum("sf,sf->s", x, x) * np.einsum("se,se->s", first, second))
    means = x.T @ first / len(x), x.T @ second / len(x)
    return float(products - np.sum(means[0] * means[1]))
