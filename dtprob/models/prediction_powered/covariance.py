"""How far an estimate may be from the truth: the sandwich covariance and its degrees of freedom."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from dtprob.models.prediction_powered.losses import AbstractLoss
from dtprob.models.prediction_powered.moments import Evaluation
from dtprob.models.prediction_powered.schemes import Mix
from dtprob.models.prediction_powered.tuning import Practice


class Spread(NamedTuple):
    """Uncertainty of an estimate.

    Attributes:
        covariance: of the parameters.
        degrees: degrees of freedom of each parameter's variance, by Welch and Satterthwaite.
    """

    covariance: Float[Array, "parameter parameter"]
    degrees: Float[Array, " parameter"]


def inverse_hessian(
    loss: AbstractLoss, evaluation: Evaluation, mix: Mix
) -> Float[Array, "parameter parameter"]:
    """Inverse of the mean second derivative of the loss over the population.

    Where it does not depend on labels every sample counts alike, otherwise it is that of the corrected loss.
    """
    return _inverse(evaluation, mix, pooled=loss.traits.linear_in_label)


@eqx.filter_jit
def _inverse(evaluation: Evaluation, mix: Mix, *, pooled: bool) -> Array:
    labelled, unlabelled = evaluation.labelled.hessian[0], evaluation.unlabelled.hessian
    if pooled:
        uses = jnp.any(mix.unlabelled != 0)
        share = jnp.where(uses, evaluation.n_unlabelled / (evaluation.n + evaluation.n_unlabelled), 0.0)
        hessian = (1 - share) * labelled + share * jnp.sum(unlabelled, axis=0)
    else:
        corrected = jnp.tensordot(mix.unlabelled, unlabelled, 1)
        hessian = (
            mix.true * labelled + corrected - jnp.tensordot(mix.predicted, evaluation.predicted.hessian, 1)
        )
    diagonal = jnp.abs(jnp.diagonal(hessian))
    scale = jnp.where(diagonal > 0, 1 / jnp.sqrt(diagonal), 1.0)
    return scale[:, None] * jnp.linalg.inv(scale[:, None] * hessian * scale) * scale


@eqx.filter_jit
def spread(
    evaluation: Evaluation, mix: Mix, inverse: Float[Array, "parameter parameter"], practice: Practice
) -> Spread:
    """The sandwich covariance of an estimate.

    Args:
        evaluation: the data at the estimate.
        mix: the weights of the corrected loss; the last two entries per parameter and context.
        inverse: inverse of the mean second derivative.
        practice: conventions.
    """
    n, count, d = evaluation.n, evaluation.n_unlabelled, len(inverse)
    lost = d if practice.lost is None else practice.lost
    inside = evaluation.context[:, None] == jnp.arange(evaluation.unlabelled.value.shape[0])
    predicted = inside.astype(inverse.dtype) @ mix.predicted.T * (evaluation.predicted_gradient @ inverse)
    influence = mix.true * (evaluation.gradient @ inverse) - predicted
    influence = influence - jnp.mean(influence, axis=0)
    labelled_degrees = jnp.maximum(n - lost, 1.0)
    labelled = influence.T @ influence / labelled_degrees / n
    unlabelled_degrees = jnp.maximum(count - min(lost, 1), 1.0)
    unlabelled = _unlabelled(evaluation, mix.unlabelled, inverse) / unlabelled_degrees
    variances = jnp.diagonal(labelled), jnp.diagonal(unlabelled)
    tiny = jnp.finfo(inverse.dtype).tiny
    total = variances[0] ** 2 / labelled_degrees + variances[1] ** 2 / unlabelled_degrees
    degrees = (variances[0] + variances[1]) ** 2 / jnp.maximum(total, tiny)
    return Spread(labelled + unlabelled, jnp.maximum(degrees, 1.0))


def _unlabelled(
    evaluation: Evaluation,
    weight: Float[Array, "parameter context"],
    inverse: Float[Array, "parameter parameter"],
) -> Float[Array, "parameter parameter"]:
    group = evaluation.unlabelled
    mean = jnp.sum(weight * (group.gradient @ inverse).T, axis=1)
    second = jnp.einsum("jc,kc,pj,cpq,qk->jk", weight, weight, inverse, group.second, inverse)
    return second - jnp.outer(mean, mean)
