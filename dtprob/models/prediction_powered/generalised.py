"""The corrected losses as generative models: generalised Bayes, at a rate that makes intervals cover.

A loss is no likelihood; exp(-rate * n * loss) has the right place but a width that depends on the unit of the
loss. Here the width is calibrated: by one rate, or by a linear map of the parameters around the estimate, so
that the posterior has the covariance of the sandwich formula. Sources: Bissiri, Holmes and Walker, A general
framework for updating belief distributions (2016); Ribatet, Cooley and Davison, Bayesian inference from
composite likelihoods (2012), for the linear map.
"""

from typing import Any, Literal, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Float, PRNGKeyArray, Scalar
from scipy import stats

from dtprob.errors import InputError
from dtprob.models.declaration import model
from dtprob.models.prediction_powered.losses import AbstractLoss, named_loss
from dtprob.models.prediction_powered.moments import Evaluation, evaluate, group_sums, labelled_rows
from dtprob.models.prediction_powered.quantile import Quantile
from dtprob.models.prediction_powered.result import Estimate
from dtprob.models.prediction_powered.sample import Chunk, Sample
from dtprob.models.prediction_powered.schemes import Mix
from dtprob.models.prediction_powered.solve import minimise

type Calibration = Literal["matrix", "scalar", "none"]


class LabelLoss(dist.Distribution):
    """The pseudo-likelihood exp(-weight * l(theta, x, y)) of each label; it cannot be drawn from.

    Args:
        loss: l.
        theta: parameters, flat.
        x: features, one row per label.
        weight: of each label, learning rate included.
    """

    pytree_data_fields = ("loss", "theta", "x", "weight")

    def __init__(
        self,
        loss: AbstractLoss,
        theta: Float[Array, " parameter"],
        x: Float[Array, "sample feature"],
        weight: Float[Array, " sample"],
        *,
        label: tuple[int, ...] = (),
    ) -> None:
        self.loss, self.theta, self.x, self.weight = loss, theta, x, weight
        super().__init__(batch_shape=(weight.shape[0],), event_shape=label)

    @property
    def support(self) -> Any:
        """All real labels."""
        return dist.constraints.independent(dist.constraints.real, len(self.event_shape))

    def log_prob(self, value: Any, intermediates: Any = None) -> Array:
        """Minus the weighted loss of each label."""
        del intermediates
        return -self.weight * jnp.asarray(self.loss.values(self.theta, self.x, value))

    def sample(self, key: PRNGKeyArray | None, sample_shape: tuple[int, ...] = ()) -> Array:
        """Refuse: a loss says how wrong a label is, not how labels come about.

        Raises:
            InputError: always.
        """
        del key, sample_shape
        remedy = "Give y, or predict with a model of the labels"
        raise InputError("labels under a loss", "observed labels", "none", remedy)


class AbstractCorrection(eqx.Module):
    """The part of a corrected loss that holds predictions."""

    def __call__(self, loss: AbstractLoss, theta: Float[Array, " parameter"]) -> Scalar:
        """Mean corrected loss minus its labelled part."""
        raise NotImplementedError


@final
class ExactCorrection(AbstractCorrection):
    """All predictions, read at every evaluation.

    Attributes:
        unlabelled: unlabelled samples with their predictions.
        predicted: labelled samples with their predictions.
        mix: weights of the terms.
    """

    unlabelled: Chunk
    predicted: Chunk
    mix: Mix

    def __call__(self, loss: AbstractLoss, theta: Float[Array, " parameter"]) -> Scalar:
        """By sums over all samples."""
        n_context = len(self.mix.unlabelled)
        plus = group_sums(loss, theta, self.unlabelled, n_context).value / len(self.unlabelled.weight)
        minus = group_sums(loss, theta, self.predicted, n_context).value / len(self.predicted.weight)
        return jnp.asarray(self.mix.unlabelled @ plus - self.mix.predicted @ minus)


@final
class QuadraticCorrection(AbstractCorrection):
    """Gradient and second derivative at one place: all there is to know of a quadratic loss.

    Attributes:
        place: where.
        gradient: there.
        hessian: there.
    """

    place: Float[Array, " parameter"]
    gradient: Float[Array, " parameter"]
    hessian: Float[Array, "parameter parameter"]

    def __call__(self, loss: AbstractLoss, theta: Float[Array, " parameter"]) -> Scalar:
        """The quadratic form, 0 at its place."""
        del loss
        step = theta - self.place
        return self.gradient @ step + 0.5 * step @ self.hessian @ step


@model(axes={"theta": ("parameter",)})
def prediction_powered(
    *,
    loss: AbstractLoss,
    x: Float[Array, "sample feature"],
    weight: Float[Array, " sample"],
    correction: AbstractCorrection,
    strength: Float[Array, ""],
    minimiser: Float[Array, " parameter"],
    center: Float[Array, " parameter"],
    turn: Float[Array, "parameter parameter"],
    prior_scale: Float[Array, " parameter"],
    y: Float[Array, "sample ..."] | None = None,
) -> None:
    """Generalised posterior of a corrected loss; `posterior_data` makes the arguments.

    Site `theta` has the parameters; the loss is taken at minimiser + turn (theta - center), where `turn`
    calibrates the width. Site `y` holds the labelled part of the loss, the factor `correction` the rest.

    Args:
        loss: the loss.
        x: features of the labelled samples.
        weight: of each label in the total loss, learning rate included.
        correction: the part with predictions.
        strength: learning rate times the number of labels.
        minimiser: of the corrected loss.
        center: the estimate, where the posterior shall lie.
        turn: linear map between the two.
        prior_scale: standard deviation of the normal prior around the estimate.
        y: labels.
    """
    theta = numpyro.sample("theta", dist.Normal(center, prior_scale).to_event(1))
    point = minimiser + turn @ (theta - center)
    label = () if y is None else y.shape[1:]
    with numpyro.plate("label", len(weight)):
        numpyro.sample("y", LabelLoss(loss, point, x, weight, label=label), obs=y)
    numpyro.factor("correction", -strength * correction(loss, point))


def posterior_data(
    loss: str | AbstractLoss,
    sample: Sample,
    estimate: Estimate,
    *,
    calibration: Calibration = "matrix",
    prior_scale: float | Float[np.ndarray, " parameter"] | None = None,
) -> dict[str, Any]:
    """The arguments of `prediction_powered` for data and their estimate.

    Args:
        loss: as in `estimate`; a quantile needs `SmoothQuantile`.
        sample: as in `estimate`.
        estimate: what it gave; its covariance and degrees of freedom set the width of the posterior.
        calibration: "matrix" gives the posterior the estimate's covariance, widened as Student's t is at the
            estimate's level; "scalar" only its total variance, by one learning rate; "none" uses rate 1.
        prior_scale: standard deviation of the prior around the estimate; 100 standard errors by default.

    Raises:
        InputError: a quantile, which has no second derivative.
    """
    if isinstance(loss, Quantile):
        raise InputError("loss", "one with a second derivative", "a quantile", "Use SmoothQuantile")
    chosen, center = named_loss(loss), np.asarray(estimate.theta)
    mix = _mean_mix(sample, estimate)
    minimiser = jnp.asarray(minimise(chosen, sample, mix, evaluate(chosen, sample, center), center))
    evaluation = evaluate(chosen, sample, minimiser)
    hessian = sample.n * _corrected(evaluation, mix, "hessian")
    covariance = _widened(estimate)
    turn, rate = _calibrated(np.asarray(hessian), covariance, calibration)
    spread = 100 * np.sqrt(np.diagonal(covariance)) if prior_scale is None else prior_scale
    return {
        "loss": chosen,
        "x": jnp.asarray(sample.features),
        "weight": rate * mix.true * jnp.asarray(sample.labelled_weight),
        "correction": _correction(chosen, sample, evaluation, mix, minimiser),
        "strength": jnp.asarray(rate * sample.n),
        "minimiser": minimiser,
        "center": jnp.asarray(center),
        "turn": jnp.asarray(turn),
        "prior_scale": jnp.broadcast_to(jnp.asarray(spread), center.shape),
        "y": jnp.asarray(sample.y),
    }


def _mean_mix(sample: Sample, estimate: Estimate) -> Mix:
    lam = np.broadcast_to(np.mean(estimate.lam.value, axis=0), (sample.n_context,))
    n, count = np.asarray(float(sample.n)), np.asarray(float(max(sample.n_unlabelled, 1)))
    return estimate.scheme.mix(n, count, lam)


def _corrected(evaluation: Evaluation, mix: Mix, part: str, *, labelled: bool = True) -> Array:
    plus = jnp.tensordot(mix.unlabelled, getattr(evaluation.unlabelled, part), 1)
    minus = jnp.tensordot(mix.predicted, getattr(evaluation.predicted, part), 1)
    own = mix.true * getattr(evaluation.labelled, part)[0] if labelled else 0.0
    return own + plus - minus


def _widened(estimate: Estimate) -> Float[np.ndarray, "parameter parameter"]:
    chance = (1 + estimate.level) / 2
    factor = stats.t.ppf(chance, np.maximum(estimate.degrees, 1.0)) / stats.norm.ppf(chance)
    return estimate.covariance * np.outer(factor, factor)


def _calibrated(
    hessian: Float[np.ndarray, "parameter parameter"],
    covariance: Float[np.ndarray, "parameter parameter"],
    calibration: Calibration,
) -> tuple[np.ndarray, float]:
    """The linear map and the learning rate."""
    unity = np.eye(len(hessian))
    if calibration == "matrix":
        return _root(hessian, -0.5) @ _root(covariance, -0.5), 1.0
    if calibration == "scalar":
        return unity, float(np.trace(np.linalg.inv(hessian)) / np.trace(covariance))
    if calibration != "none":
        raise InputError("calibration", "matrix, scalar or none", repr(calibration), "Choose one of them")
    return unity, 1.0


def _root(matrix: np.ndarray, power: float) -> np.ndarray:
    """A power of a symmetric positive matrix."""
    values, vectors = np.linalg.eigh(matrix)
    floor = len(values) * np.finfo(values.dtype).eps * np.max(values)
    return (vectors * np.maximum(values, floor) ** power) @ vectors.T


def _correction(
    loss: AbstractLoss, sample: Sample, evaluation: Evaluation, mix: Mix, place: Float[Array, " parameter"]
) -> AbstractCorrection:
    if loss.traits.quadratic or not sample.has_predictions:
        gradient = _corrected(evaluation, mix, "gradient", labelled=False)
        return QuadraticCorrection(place, gradient, _corrected(evaluation, mix, "hessian", labelled=False))
    chunks = list(sample.chunks())
    whole: Chunk = jax.tree.map(lambda *parts: jnp.concatenate(parts)[: sample.n_unlabelled], *chunks)
    if loss.traits.linear_in_label:
        whole = whole._replace(prediction=jnp.mean(whole.prediction, axis=1, keepdims=True))
    parts: tuple[Chunk, Mix] = jax.tree.map(jnp.asarray, (labelled_rows(sample)[1], mix))
    return ExactCorrection(whole, *parts)
