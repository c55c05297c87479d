"""Quantiles: their loss has no second derivative, but their estimate and interval need only sorting.

The corrected distribution function is F = F_Y + lambda (F~_f - F_f); the corrected check loss is the integral
of F less the level. The estimate is its minimiser, and the interval holds all values that a test at that level
does not reject.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, final

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy import optimize, stats

from dtprob.errors import InputError
from dtprob.models.prediction_powered.losses import check_scalar
from dtprob.models.prediction_powered.moments import Evaluation, Group, locate
from dtprob.models.prediction_powered.result import Estimate
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.schemes import Scheme
from dtprob.models.prediction_powered.tuning import Lambda, Practice, fixed, tune


@final
@dataclass(frozen=True)
class Quantile:
    """The quantile of the label.

    Attributes:
        level: which, between 0 and 1.

    Raises:
        InputError: a level out of range.
    """

    level: float

    def __post_init__(self) -> None:
        """Check the level."""
        if not 0 < self.level < 1:
            remedy = "Give 0.5 for the median"
            raise InputError("quantile", "a level between 0 and 1", repr(self.level), remedy)


class Steps(NamedTuple):
    """The data as steps of the corrected distribution functions, over all distinct values.

    Attributes:
        value: the distinct values, ascending.
        true: distribution function of the labels there.
        predicted: of the predictions of labelled samples.
        both: of the greater of the two.
        unlabelled: of the predictions of unlabelled samples, all predictors together.
        square: mean square over unlabelled samples of the share of predictors at or below the value.
        square_true, square_predicted, square_unlabelled: like true, predicted and unlabelled, with squared
            weights.
    """

    value: Float[np.ndarray, " value"]
    true: Float[np.ndarray, " value"]
    predicted: Float[np.ndarray, " value"]
    both: Float[np.ndarray, " value"]
    unlabelled: Float[np.ndarray, " value"]
    square: Float[np.ndarray, " value"]
    square_true: Float[np.ndarray, " value"]
    square_predicted: Float[np.ndarray, " value"]
    square_unlabelled: Float[np.ndarray, " value"]

    def function(self, true: float, unlabelled: float, predicted: float) -> Float[np.ndarray, " value"]:
        """The mixed distribution function."""
        return true * self.true + unlabelled * self.unlabelled - predicted * self.predicted

    def at(self, theta: float) -> Steps:
        """The functions at one value."""
        index = np.searchsorted(self.value, theta, side="right") - 1
        return Steps(*(np.atleast_1d(part[index]) for part in self))


def estimate_quantile(
    loss: Quantile, sample: Sample, scheme: Scheme, *, level: float, practice: Practice
) -> Estimate:
    """The quantile under a scheme; see `estimate`.

    The predictions of unlabelled samples are held in memory, features are not read.

    Raises:
        InputError: labels with more than one entry.
    """
    check_scalar(sample.y, "a quantile")
    problem = quantile_problem(loss, sample, scheme)
    start = practice.pilot if scheme.lam is None else scheme.lam
    lam = fixed(start, problem.evaluation(0.0))
    theta = problem.minimiser(lam)
    for _ in range(practice.rounds if scheme.is_tuned else 0):
        lam = tune(problem.evaluation(theta), np.ones((1, 1)), "overall", practice)
        theta = problem.minimiser(lam)
    return problem.result(theta, lam, level)


def _steps(sample: Sample) -> Steps:
    weight, y = sample.labelled_weight, sample.y
    prediction = y if sample.prediction is None else sample.prediction
    blocks = list(sample.blocks()) if sample.has_predictions else []
    if not all(np.isfinite(block.prediction).all() for block in blocks):
        locate(sample)
    unlabelled = np.concatenate([block.prediction for block in blocks]) if blocks else np.zeros((0, 1))
    weights = np.concatenate([block.weight for block in blocks]) if blocks else np.zeros(0)
    folds, count = unlabelled.shape[1], max(sample.n_unlabelled, 1)
    ordered = np.sort(unlabelled, axis=1)
    rank = (2 * np.arange(folds) + 1) / folds**2
    value = np.unique(np.concatenate([y, prediction, unlabelled.ravel()]))

    def function(points: np.ndarray, mass: np.ndarray) -> np.ndarray:
        place = np.searchsorted(value, points.ravel())
        return np.cumsum(np.bincount(place, mass.ravel(), minlength=len(value)))

    n = sample.n
    return Steps(
        value=value,
        true=function(y, weight / n),
        predicted=function(prediction, weight / n),
        both=function(np.maximum(y, prediction), weight**2 / n),
        unlabelled=function(ordered, np.repeat(weights[:, None], folds, 1) / (folds * count)),
        square=function(ordered, weights[:, None] ** 2 * rank / count),
        square_true=function(y, weight**2 / n),
        square_predicted=function(prediction, weight**2 / n),
        square_unlabelled=function(ordered, np.repeat(weights[:, None] ** 2, folds, 1) / (folds * count)),
    )


def quantile_problem(loss: Quantile, sample: Sample, scheme: Scheme) -> QuantileProblem:
    """A quantile's data, sorted."""
    return QuantileProblem(loss, sample, scheme, _steps(sample))


def _about_mean(
    mean: Float[np.ndarray, " value"],
    second: Float[np.ndarray, " value"],
    twice: Float[np.ndarray, " value"],
    square: Float[np.ndarray, "1"],
) -> Float[np.ndarray, " value"]:
    """Mean square of weight (x - mean), from the means of weight x, (weight x)^2, weight^2 x and weight^2."""
    return np.maximum(second - mean * (2 * twice - square * mean), 0.0)


@final
@dataclass(frozen=True)
class QuantileProblem:
    """A quantile, a scheme and data, with the data's distribution functions."""

    loss: Quantile
    sample: Sample
    scheme: Scheme
    steps: Steps

    def evaluation(self, theta: float) -> Evaluation:
        """The gradients of the check loss at theta, in the form that tuning takes."""
        sample, level, there, end = self.sample, self.loss.level, self.steps.at(theta), self.steps.at(np.inf)
        prediction = sample.y if sample.prediction is None else sample.prediction

        def gradient(values: np.ndarray) -> np.ndarray:
            return (sample.labelled_weight * ((values <= theta) - level))[:, None]

        mean = there.unlabelled - level * end.unlabelled
        twice = there.square_unlabelled - level * end.square_unlabelled
        second = there.square - level * (there.square_unlabelled + twice)
        one = np.ones((1, 1, 1))
        nothing = Group(np.zeros(1), np.zeros((1, 1)), one, one)
        return Evaluation(
            labelled=nothing,
            predicted=nothing,
            unlabelled=Group(
                np.zeros(1), mean[None], one, second[None, None], twice[None], end.square_unlabelled
            ),
            gradient=gradient(sample.y),
            predicted_gradient=gradient(prediction),
            context=np.zeros(sample.n, int),
            n=np.asarray(float(sample.n)),
            n_unlabelled=np.asarray(float(max(sample.n_unlabelled, 1))),
            weight=sample.labelled_weight,
        )

    def mix(self, lam: Lambda) -> tuple[float, float, float]:
        """The weights of the three distribution functions."""
        n, count = np.asarray(float(self.sample.n)), np.asarray(float(self.sample.n_unlabelled))
        mix = self.scheme.mix(n, count, lam.value[0])
        return float(mix.true), float(mix.unlabelled[0]), float(mix.predicted[0])

    def minimiser(self, lam: Lambda) -> float:
        """The least minimiser of the corrected check loss."""
        return float(self.minimisers(self.mix(lam), np.array([self.loss.level]))[0])

    def minimisers(
        self, mix: tuple[float, float, float], level: Float[np.ndarray, " level"]
    ) -> Float[np.ndarray, " level"]:
        """Those for several levels.

        The corrected function may fall, so that it passes a level more than once. Made to rise by isotonic
        regression, in which a value counts by the gap to the next, it has the same minimiser. Levels are
        lowered by a rounding error, so that a flat piece of the loss ends where it begins.
        """
        value, function = self.steps.value, self.steps.function(*mix)
        if len(value) == 1:
            return np.full(level.shape, value[0])
        rising: Any = optimize.isotonic_regression(function[:-1], weights=np.diff(value))
        return value[np.searchsorted(rising.x, level - 1e-12)]

    def variance(self, steps: Steps, mix: tuple[float, float, float]) -> Float[np.ndarray, " value"]:
        """Variance of the mixed distribution function at each value."""
        true, unlabelled, predicted = mix
        end = self.steps.at(np.inf)
        square = true**2 * steps.square_true + predicted**2 * steps.square_predicted
        labelled = _about_mean(
            true * steps.true - predicted * steps.predicted,
            square - 2 * true * predicted * steps.both,
            true * steps.square_true - predicted * steps.square_predicted,
            end.square_true,
        )
        rest = unlabelled**2 * _about_mean(
            steps.unlabelled, steps.square, steps.square_unlabelled, end.square_unlabelled
        )
        return labelled / self.sample.n + rest / max(self.sample.n_unlabelled, 1)

    def unlabelled_variance(self, theta: float) -> float:
        """Variance of the unlabelled distribution function at a value."""
        there = self.steps.at(theta)
        return float(self.variance(there, (0.0, 1.0, 0.0))[0])

    def _ends(self, inside: Int[np.ndarray, " inside"]) -> tuple[float, float]:
        """The ends of steps that are not rejected, each of which goes on up to the next value."""
        value = self.steps.value
        return float(value[inside[0]]), float(value[min(inside[-1] + 1, len(value) - 1)])

    def result(self, theta: float, lam: Lambda, level: float) -> Estimate:
        """The estimate with the interval of all values that are not rejected."""
        mix, z = self.mix(lam), stats.norm.ppf((1 + level) / 2)
        deviation = np.abs(self.steps.function(*mix) - self.loss.level)
        inside = np.flatnonzero(deviation < z * np.sqrt(self.variance(self.steps, mix)))
        low, high = self._ends(inside) if len(inside) else (theta, theta)
        variance = ((high - low) / (2 * z)) ** 2
        there = self.steps.at(theta)
        own, alone = self.variance(there, mix)[0], self.variance(there, (1.0, 0.0, 0.0))[0]
        return Estimate(
            theta=np.array([theta]),
            covariance=np.array([[variance]]),
            degrees=np.array([np.inf]),
            low=np.array([low]),
            high=np.array([high]),
            level=level,
            lam=jax.tree.map(np.asarray, lam),
            labels_only_variance=np.array([variance * alone / own if own > 0 else 0.0]),
            scheme=self.scheme,
            n=self.sample.n,
            n_unlabelled=self.sample.n_unlabelled if self.sample.has_predictions else 0,
        )
