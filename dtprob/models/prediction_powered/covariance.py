"""How far an estimate may be from the truth: the sandwich covariance and its degrees of freedom."""

from typing import NamedTuple

from jaxtyping import Float, Int

from dtprob.models.prediction_powered.arrays import Values, compiled_for_jax, namespace
from dtprob.models.prediction_powered.losses import AbstractLoss
from dtprob.models.prediction_powered.moments import Evaluation, centred
from dtprob.models.prediction_powered.schemes import Mix
from dtprob.models.prediction_powered.tuning import Practice


class Spread(NamedTuple):
    """Uncertainty of an estimate.

    Attributes:
        covariance: of the parameters.
        degrees: degrees of freedom of each parameter's variance, by Welch and Satterthwaite.
    """

    covariance: Float[Values, "parameter parameter"]
    degrees: Float[Values, " parameter"]


def inverse_hessian(
    loss: AbstractLoss, evaluation: Evaluation, mix: Mix
) -> Float[Values, "parameter parameter"]:
    """Inverse of the mean second derivative of the loss over the population.

    Where it does not depend on labels every sample counts alike, otherwise it is that of the corrected loss.
    """
    return _inverse(evaluation, mix, pooled=loss.traits.linear_in_label)


@compiled_for_jax
def _inverse(evaluation: Evaluation, mix: Mix, *, pooled: bool) -> Values:
    xp = namespace(evaluation.gradient)
    labelled, unlabelled = evaluation.labelled.hessian[0], evaluation.unlabelled.hessian
    if pooled:
        uses = xp.any(mix.unlabelled != 0)
        share = xp.where(uses, evaluation.n_unlabelled / (evaluation.n + evaluation.n_unlabelled), 0.0)
        hessian = (1 - share) * labelled + share * xp.sum(unlabelled, axis=0)
    else:
        corrected = xp.tensordot(mix.unlabelled, unlabelled, 1)
        hessian = (
            mix.true * labelled + corrected - xp.tensordot(mix.predicted, evaluation.predicted.hessian, 1)
        )
    diagonal = xp.abs(xp.diagonal(hessian))
    scale = xp.where(diagonal > 0, 1 / xp.sqrt(diagonal), 1.0)
    return scale[:, None] * xp.linalg.inv(scale[:, None] * hessian * scale) * scale


@compiled_for_jax
def spread(
    evaluation: Evaluation,
    mix: Mix,
    inverse: Float[Values, "parameter parameter"],
    practice: Practice,
    tuned: Int[Values, ""] | int = 0,
) -> Spread:
    """The sandwich covariance of an estimate.

    Args:
        evaluation: the data at the estimate.
        mix: the weights of the corrected loss; the last two entries per parameter and context.
        inverse: inverse of the mean second derivative.
        practice: conventions.
        tuned: degrees of freedom lost beside those of the parameters, to lambdas that were tuned on the labels
            (`tuning_cost`).
    """
    xp = namespace(evaluation.gradient)
    n, count, d = evaluation.n, evaluation.n_unlabelled, len(inverse)
    lost = d if practice.lost is None else practice.lost
    inside = evaluation.context[:, None] == xp.arange(evaluation.unlabelled.value.shape[0])
    predicted = inside.astype(inverse.dtype) @ mix.predicted.T * (evaluation.predicted_gradient @ inverse)
    influence = mix.true * (evaluation.gradient @ inverse) - predicted
    influence = centred(influence, evaluation.weight)
    effective = n if evaluation.weight is None else effective_number(evaluation.weight)
    labelled_degrees = xp.maximum(effective - lost - tuned, 1.0)
    labelled = influence.T @ influence * (effective / labelled_degrees) / n**2
    # a fit to as many labels as parameters leaves no error to look at
    counted = n if evaluation.weight is None else (evaluation.weight > 0).sum()
    untold = (counted <= lost) & xp.eye(d, dtype=bool)
    labelled = xp.where(untold, xp.inf, labelled)
    unlabelled_degrees = xp.maximum(count - min(lost, 1), 1.0)
    unlabelled = _unlabelled(evaluation, mix.unlabelled, inverse) / unlabelled_degrees
    variances = xp.diagonal(labelled), xp.diagonal(unlabelled)
    tiny = xp.finfo(inverse.dtype).tiny
    total = variances[0] ** 2 / labelled_degrees + variances[1] ** 2 / unlabelled_degrees
    whole = variances[0] + variances[1]
    degrees = xp.where(xp.isfinite(whole), whole**2 / xp.maximum(total, tiny), 1.0)
    return Spread(labelled + unlabelled, xp.maximum(degrees, 1.0))


def effective_number(weight: Float[Values, " sample"]) -> Float[Values, ""]:
    """How many samples of one weight say as much (Kish, Survey Sampling, 1965)."""
    return weight.sum() ** 2 / (weight @ weight)


def _unlabelled(
    evaluation: Evaluation,
    weight: Float[Values, "parameter context"],
    inverse: Float[Values, "parameter parameter"],
) -> Float[Values, "parameter parameter"]:
    group = evaluation.unlabelled
    mean, offset = ((weight * (part @ inverse).T).sum(axis=1) for part in (group.gradient, group.offset))
    turned = inverse.T @ group.second @ inverse
    second = (weight.T[:, :, None] * weight.T[:, None, :] * turned).sum(axis=0)
    outer = mean[:, None] * offset
    return second - (outer + outer.T)
