"""What tuning and fitting need to know of the data at one parameter vector.

The unlabelled samples enter only through sums, which are taken chunk by chunk; the labelled ones, few, are
kept sample by sample.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dtprob.errors import InputError
from dtprob.models.prediction_powered.losses import AbstractLoss
from dtprob.models.prediction_powered.sample import Chunk, Sample


class Group(NamedTuple):
    """Weighted sums over a group of samples, divided by its total weight, per context.

    Attributes:
        value: loss.
        gradient: gradient; the mean of those of all predictors.
        hessian: second derivative.
        second: outer product of the (weighted) gradient with itself.
    """

    value: Float[Array, " context"]
    gradient: Float[Array, "context parameter"]
    hessian: Float[Array, "context parameter parameter"]
    second: Float[Array, "context parameter parameter"]


class Evaluation(NamedTuple):
    """The data at one parameter vector.

    Attributes:
        labelled: sums over labelled samples with their labels (one context).
        predicted: sums over labelled samples with their predictions.
        unlabelled: sums over unlabelled samples with their predictions.
        gradient: weighted gradient of each labelled sample at its label.
        predicted_gradient: at its prediction.
        context: of each labelled sample.
        n: number of labelled samples.
        n_unlabelled: number of unlabelled samples.
    """

    labelled: Group
    predicted: Group
    unlabelled: Group
    gradient: Float[Array, "sample parameter"]
    predicted_gradient: Float[Array, "sample parameter"]
    context: Int[Array, " sample"]
    n: Float[Array, ""]
    n_unlabelled: Float[Array, ""]


def evaluate(loss: AbstractLoss, sample: Sample, theta: Float[Array, " parameter"]) -> Evaluation:
    """Read the data once at `theta`.

    Raises:
        InputError: NaN or infinity among the unlabelled features or predictions.
    """
    n_context = sample.n_context
    rows = labelled_rows(sample)
    labelled, predicted, gradient, predicted_gradient = _labelled(loss, theta, *rows, n_context)
    return Evaluation(
        labelled,
        predicted,
        _unlabelled(loss, sample, theta, n_context),
        gradient,
        predicted_gradient,
        rows[1].context,
        jnp.asarray(sample.n, theta.dtype),
        jnp.asarray(max(sample.n_unlabelled, 1), theta.dtype),
    )


def labelled_rows(sample: Sample) -> tuple[Chunk, Chunk]:
    """The labelled samples with their labels, and with their predictions."""
    x, weight = jnp.asarray(sample.features), jnp.asarray(sample.labelled_weight)
    context = jnp.asarray(sample.labelled_context)
    y = jnp.asarray(sample.y)[:, None]
    prediction = y if sample.prediction is None else jnp.asarray(sample.prediction)[:, None]
    return Chunk(x, y, weight, jnp.zeros_like(context)), Chunk(x, prediction, weight, context)


@eqx.filter_jit
def _labelled(
    loss: AbstractLoss, theta: Float[Array, " parameter"], true: Chunk, predicted: Chunk, n_context: int
) -> tuple[Group, Group, Array, Array]:
    groups = [group_sums(loss, theta, true, 1), group_sums(loss, theta, predicted, n_context)]
    gradients = [
        rows.weight[:, None] * loss.gradients(theta, rows.x, rows.prediction[:, 0])
        for rows in (true, predicted)
    ]
    means = [_scaled(group, len(true.weight)) for group in groups]
    return means[0], means[1], gradients[0], gradients[1]


def _unlabelled(
    loss: AbstractLoss, sample: Sample, theta: Float[Array, " parameter"], n_context: int
) -> Group:
    if not sample.has_predictions:
        return _empty(theta, n_context)
    total: Group | None = None
    for chunk in sample.chunks(averaged=loss.traits.linear_in_label):
        sums = _chunk_sums(loss, theta, chunk, n_context)
        total = sums if total is None else jax.tree.map(jnp.add, total, sums)
    if total is None or not all(bool(jnp.all(jnp.isfinite(part))) for part in total):
        _locate(sample)
        raise InputError(
            "loss",
            "finite values at every sample",
            "NaN or infinity",
            "Scale the features, or check the loss",
        )
    return _scaled(total, sample.n_unlabelled)


def _empty(theta: Float[Array, " parameter"], n_context: int) -> Group:
    zero, d = jnp.zeros(n_context, theta.dtype), len(theta)
    matrix = jnp.zeros((n_context, d, d), theta.dtype)
    return Group(zero, jnp.zeros((n_context, d), theta.dtype), matrix, matrix)


def _scaled(group: Group, count: int) -> Group:
    return jax.tree.map(lambda total: total / count, group)


def group_sums(loss: AbstractLoss, theta: Float[Array, " parameter"], chunk: Chunk, n_context: int) -> Group:
    """Weighted sums of loss, gradient, second derivative and squared gradient, per context."""
    x, prediction, weight, context = chunk
    if loss.traits.linear_in_label:
        prediction = jnp.mean(prediction, axis=1, keepdims=True)
    columns = jnp.moveaxis(prediction, 1, 0)

    def mean_over_predictors(function: Callable[[Array], Array]) -> Array:
        return jnp.mean(jax.vmap(function)(columns), axis=0) if len(columns) > 1 else function(columns[0])

    values = mean_over_predictors(lambda y: loss.values(theta, x, y))
    gradients = mean_over_predictors(lambda y: loss.gradients(theta, x, y))

    def of_context(masked: Float[Array, " sample"]) -> Group:
        weighted = masked[:, None] * gradients
        hessian = mean_over_predictors(lambda y: loss.hessian(theta, x, y, masked))
        return Group(masked @ values, jnp.sum(weighted, axis=0), hessian, weighted.T @ weighted)

    if n_context == 1:
        return jax.tree.map(lambda total: total[None], of_context(weight))
    masks = weight * (context == jnp.arange(n_context)[:, None])
    return jax.vmap(of_context)(masks)


_chunk_sums = eqx.filter_jit(group_sums)


def _locate(sample: Sample) -> None:
    """Raise an error that names the first unlabelled sample that is not finite, if there is one."""
    for number, chunk in enumerate(sample.chunks()):
        for name, array in (("x_unlabelled", chunk.x), ("prediction_unlabelled", chunk.prediction)):
            bad = ~np.isfinite(np.asarray(array)).reshape(len(array), -1).all(axis=1)
            if bad.any():
                index = number * sample.rows_per_chunk + int(np.argmax(bad))
                got = f"NaN or infinity at sample {index}"
                raise InputError(name, "finite numbers", got, "Remove the sample")
