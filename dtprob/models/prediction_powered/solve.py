"""The minimiser of a corrected loss, by Newton's method over one or more passes through the data."""

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from dtprob.errors import InputError
from dtprob.models.prediction_powered.arrays import Values, compiled_for_jax, namespace
from dtprob.models.prediction_powered.losses import AbstractLoss
from dtprob.models.prediction_powered.moments import Evaluation, evaluate
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.schemes import Mix

_MAX_STEPS: Final = 60
_MAX_HALVINGS: Final = 30
_FLAT: Final = 1e-8
"""Curvature over that at the start below which a loss is flat: its minimum is at infinity."""


class Newton(NamedTuple):
    """A Newton step of the corrected loss.

    Attributes:
        value: the corrected loss here.
        step: what to subtract from theta.
        decrement: gradient times step: twice what the step is expected to gain.
        condition: smallest curvature, in units that make the curvature along each parameter 1.
        curvature: along each parameter.
    """

    value: Float[Values, ""]
    step: Float[Values, " parameter"]
    decrement: Float[Values, ""]
    condition: Float[Values, ""]
    curvature: Float[Values, " parameter"]


@compiled_for_jax
def newton(evaluation: Evaluation, mix: Mix) -> Newton:
    """The Newton step at an evaluation; directions of negative curvature are followed downhill."""
    labelled, unlabelled, predicted = evaluation.labelled, evaluation.unlabelled, evaluation.predicted
    xp = namespace(evaluation.gradient)

    def total(part: str) -> Values:
        plus = xp.einsum("c,c...->...", mix.unlabelled, getattr(unlabelled, part))
        minus = xp.einsum("c,c...->...", mix.predicted, getattr(predicted, part))
        return mix.true * getattr(labelled, part)[0] + plus - minus

    gradient, hessian = total("gradient"), total("hessian")
    diagonal = xp.abs(xp.diagonal(hessian))
    scale = xp.where(diagonal > 0, 1 / xp.sqrt(diagonal), 1.0)
    curvature, vectors = xp.linalg.eigh(scale[:, None] * hessian * scale)
    size = xp.abs(curvature)
    floor = xp.finfo(size.dtype).eps * len(size)
    step = scale * (vectors @ ((vectors.T @ (scale * gradient)) / xp.maximum(size, floor)))
    return Newton(total("value"), step, gradient @ step, xp.min(size), diagonal)


def minimise(
    loss: AbstractLoss, sample: Sample, mix: Mix, start: Evaluation, theta: Float[Values, " parameter"]
) -> Float[Values, " parameter"]:
    """The minimiser of the corrected loss.

    Args:
        loss: the loss.
        sample: the data.
        mix: the weights of its three terms.
        start: `evaluate(loss, sample, theta)`.
        theta: where to start.

    Raises:
        InputError: the loss overflows at the start, has no single minimiser (dependent features), or none at a finite place
            (separable labels).
    """
    if not _is_finite(start):
        raise InputError("loss", "finite values at every sample", "infinity or NaN", "Scale the features")
    tolerance = float(np.finfo(theta.dtype).eps)
    move = first = newton(start, mix)
    _check_condition(move, tolerance, len(theta))
    for _ in range(_MAX_STEPS):
        if bool(np.any(move.curvature < _FLAT * first.curvature)):
            break
        if loss.traits.quadratic or float(move.decrement) <= np.sqrt(tolerance):
            return theta - move.step  # squares what is left of the decrement
        theta, move = _descend(loss, sample, mix, theta, move)
    remedy = (
        "Drop features that tell the labels apart perfectly, add labels, or use a scheme with predictions"
    )
    raise InputError("corrected loss", f"a minimum within {_MAX_STEPS} steps", "none", remedy)


def _descend(
    loss: AbstractLoss, sample: Sample, mix: Mix, theta: Float[Values, " parameter"], move: Newton
) -> tuple[Values, Newton]:
    """Take the step, halved until the loss falls (or does not rise beyond rounding)."""
    slack = 10 * float(np.finfo(theta.dtype).eps) * (1 + abs(float(move.value)))
    length = 1.0
    for _ in range(_MAX_HALVINGS):
        candidate = theta - length * move.step
        evaluation = _evaluate_quietly(loss, sample, candidate)
        if evaluation is not None:
            following = newton(evaluation, mix)
            if float(following.value) <= float(move.value) - 1e-4 * length * float(move.decrement) + slack:
                return candidate, following
        length /= 2
    remedy = "Check that the loss is differentiable, and its scale"
    raise InputError("corrected loss", "a value that falls along its gradient", "none", remedy)


def _evaluate_quietly(
    loss: AbstractLoss, sample: Sample, theta: Float[Values, " parameter"]
) -> Evaluation | None:
    """None where a step led so far that the loss overflows."""
    try:
        evaluation = evaluate(loss, sample, theta)
    except InputError:
        return None
    return evaluation if _is_finite(evaluation) else None


def _is_finite(evaluation: Evaluation) -> bool:
    """Whether loss, gradient and second derivative are finite on the labelled samples."""
    return all(bool(np.isfinite(np.asarray(part)).all()) for part in evaluation.labelled[:3])


def _check_condition(move: Newton, tolerance: float, dimension: int) -> None:
    if float(move.condition) <= 10 * dimension * tolerance:
        remedy = "Drop features that are constant or sums of others, or add samples"
        got = "a direction without curvature"
        raise InputError("features", "independent columns, fewer than samples", got, remedy)
