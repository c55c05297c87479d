"""What tuning and fitting need to know of the data at one parameter vector.

The unlabelled samples enter only through sums, which are taken chunk by chunk; the labelled ones, few, are
kept sample by sample.
"""

from collections.abc import Callable, Generator
from functools import partial
from operator import add
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from dtprob.errors import InputError
from dtprob.models.prediction_powered.arrays import Values, compiled_for_jax, each, namespace
from dtprob.models.prediction_powered.losses import AbstractLoss
from dtprob.models.prediction_powered.sample import Chunk, Sample, averaged


class Group(NamedTuple):
    """Weighted sums over a group of samples, divided by its total weight, per context.

    Attributes:
        value: loss.
        gradient: gradient; the mean of those of all predictors.
        hessian: second derivative.
        second: outer product of the (weighted) gradient with itself.
        twice: gradient, weighted by the squares of the weights; None where all weights are 1.
        square: square of the weights; None where all are 1.
    """

    value: Float[Values, " context"]
    gradient: Float[Values, "context parameter"]
    hessian: Float[Values, "context parameter parameter"]
    second: Float[Values, "context parameter parameter"]
    twice: Float[Values, "context parameter"] | None = None
    square: Float[Values, " context"] | None = None

    @property
    def squares(self) -> tuple[Float[Values, "context parameter"], Float[Values, ""] | float]:
        """The gradient weighted by the squares of the weights, and their sum over all contexts."""
        if self.twice is None or self.square is None:
            return self.gradient, 1.0
        return self.twice, self.square.sum()

    @property
    def offset(self) -> Float[Values, "context parameter"]:
        """What turns `second` into a covariance: less gradient offset^T + offset gradient^T.

        A mean is divided by the total weight, so that a row adds weight (gradient - mean) to its error.
        """
        twice, square = self.squares
        return twice - square / 2 * self.gradient


def each_part(function: Callable[..., Any], *groups: Group) -> Group:
    """A group of what a function makes of the groups' parts, where there are any."""
    rows = zip(*groups, strict=True)
    found: list[Any] = [None if parts[0] is None else function(*parts) for parts in rows]
    return Group(*found)


def centred(rows: Float[Values, "sample ..."], weight: Float[Values, " sample"] | None) -> Values:
    """What each weighted row adds to the error of a mean that is divided by the total weight."""
    mean = rows.mean(axis=0)
    return rows - (mean if weight is None else weight.reshape(-1, *(1 for _ in mean.shape)) * mean)


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
        weight: of each labelled sample; None where all are 1.
    """

    labelled: Group
    predicted: Group
    unlabelled: Group
    gradient: Float[Values, "sample parameter"]
    predicted_gradient: Float[Values, "sample parameter"]
    context: Int[Values, " sample"]
    n: Float[Values, ""]
    n_unlabelled: Float[Values, ""]
    weight: Float[Values, " sample"] | None = None


def evaluate(loss: AbstractLoss, sample: Sample, theta: Float[Values, " parameter"]) -> Evaluation:
    """Read the data once at `theta`.

    Raises:
        InputError: NaN or infinity among the unlabelled features or predictions.
    """
    xp = np if loss.traits.numpy else jnp
    theta = xp.asarray(theta)
    n_context = sample.n_context
    rows = labelled_rows(sample)
    labelled, predicted, gradient, predicted_gradient = _labelled(loss, theta, *rows, n_context)
    return Evaluation(
        labelled,
        predicted,
        _unlabelled(loss, sample, theta, n_context),
        gradient,
        predicted_gradient,
        xp.asarray(rows[1].context),
        xp.asarray(sample.n, theta.dtype),
        xp.asarray(max(sample.n_unlabelled, 1), theta.dtype),
        None if sample.weight is None else xp.asarray(sample.weight),
    )


def labelled_rows(sample: Sample) -> tuple[Chunk, Chunk]:
    """The labelled samples with their labels, and with their predictions, as NumPy's arrays."""
    x, weight, context = sample.features, sample.labelled_weight, sample.labelled_context
    prediction = sample.y if sample.prediction is None else sample.prediction
    true = Chunk(x, sample.y[:, None], weight, np.zeros_like(context))
    return true, Chunk(x, prediction[:, None], weight, context)


@compiled_for_jax
def _labelled(
    loss: AbstractLoss, theta: Float[Values, " parameter"], true: Chunk, predicted: Chunk, n_context: int
) -> tuple[Group, Group, Values, Values]:
    groups = [group_sums(loss, theta, true, 1), group_sums(loss, theta, predicted, n_context)]
    gradients = [
        rows.weight[:, None] * loss.gradients(theta, rows.x, rows.prediction[:, 0])
        for rows in (true, predicted)
    ]
    means = [_scaled(group, len(true.weight)) for group in groups]
    return means[0], means[1], gradients[0], gradients[1]


def _unlabelled(
    loss: AbstractLoss, sample: Sample, theta: Float[Values, " parameter"], n_context: int
) -> Group:
    if not sample.has_predictions:
        return _empty(theta, n_context)
    total: Group | None = None
    for sums in _all_sums(loss, sample, theta, n_context):
        total = sums if total is None else each_part(add, total, sums)
    if total is None or not all(np.isfinite(part).all() for part in total if part is not None):
        locate(sample)
        raise InputError(
            "loss",
            "finite values at every sample",
            "NaN or infinity",
            "Scale the features, or check the loss",
        )
    return _scaled(total, sample.n_unlabelled)


def _all_sums(
    loss: AbstractLoss, sample: Sample, theta: Float[Values, " parameter"], n_context: int
) -> Generator[Group]:
    """The sums over one part of the unlabelled samples after another."""
    weighted = sample.weight_unlabelled is not None
    if not loss.traits.numpy:
        for chunk in sample.chunks(averaged=loss.traits.linear_in_label):
            yield _chunk_sums(loss, theta, chunk, n_context, weighted=weighted)
        return
    derivatives = Derivatives.of(loss)
    for block in sample.blocks():
        with np.errstate(all="ignore"):
            sums = _sums(derivatives, theta, block, n_context, weighted=weighted)
        yield sums


def _empty(theta: Float[Values, " parameter"], n_context: int) -> Group:
    xp, d = namespace(theta), len(theta)
    matrix = xp.zeros((n_context, d, d), theta.dtype)
    return Group(xp.zeros(n_context, theta.dtype), xp.zeros((n_context, d), theta.dtype), matrix, matrix)


def _scaled(group: Group, count: int) -> Group:
    return each_part(lambda total: total / count, group)


class Derivatives(NamedTuple):
    """The methods of a loss as plain functions; a block of samples takes less time than a call of a module's."""

    values: Callable[..., Any]
    gradients: Callable[..., Any]
    hessian: Callable[..., Any]
    linear_in_label: bool

    @classmethod
    def of(cls, loss: AbstractLoss) -> Self:
        """Of a loss."""
        kind = type(loss)
        methods = (partial(method, loss) for method in (kind.values, kind.gradients, kind.hessian))
        return cls(*methods, linear_in_label=loss.traits.linear_in_label)


def group_sums(
    loss: AbstractLoss,
    theta: Float[Values, " parameter"],
    chunk: Chunk,
    n_context: int,
    *,
    weighted: bool = False,
) -> Group:
    """Weighted sums of loss, gradient, second derivative and squared gradient, per context.

    Args:
        loss: the loss.
        theta: parameters.
        chunk: the samples.
        n_context: number of contexts.
        weighted: sum with the squares of the weights too.
    """
    return _sums(Derivatives.of(loss), theta, chunk, n_context, weighted=weighted)


def _sums(
    derivatives: Derivatives,
    theta: Float[Values, " parameter"],
    chunk: Chunk,
    n_context: int,
    *,
    weighted: bool,
) -> Group:
    x, prediction, weight, context = chunk
    if derivatives.linear_in_label:
        prediction = averaged(prediction)
    values = over_predictors(lambda y: derivatives.values(theta, x, y), prediction)
    gradients = over_predictors(lambda y: derivatives.gradients(theta, x, y), prediction)

    def of_context(masked: Any) -> Group:
        rows = masked[:, None] * gradients
        hessian = over_predictors(lambda y: derivatives.hessian(theta, x, y, masked), prediction)
        squares = (masked @ rows, masked @ masked) if weighted else (None, None)
        return Group(masked @ values, masked @ gradients, hessian, rows.T @ rows, *squares)

    if n_context == 1:
        return each_part(lambda total: total[None], of_context(weight))
    masks = weight * (context == namespace(context).arange(n_context)[:, None])
    return each(of_context, masks)


def over_predictors(function: Callable[[Any], Any], prediction: Values) -> Any:
    """The mean over predictors of a function of the predicted labels."""
    if prediction.shape[1] == 1:
        return function(prediction[:, 0])
    return jnp.mean(jax.vmap(function, 1)(prediction), axis=0)


_chunk_sums = eqx.filter_jit(group_sums)


def locate(sample: Sample) -> None:
    """Raise an error that names the first unlabelled sample that is not finite, if there is one."""
    for number, chunk in enumerate(sample.chunks()):
        for name, array in (("x_unlabelled", chunk.x), ("prediction_unlabelled", chunk.prediction)):
            bad = ~np.isfinite(np.asarray(array)).reshape(len(array), -1).all(axis=1)
            if bad.any():
                index = number * sample.rows_per_chunk + int(np.argmax(bad))
                got = f"NaN or infinity at sample {index}"
                raise InputError(name, "finite numbers", got, "Remove the sample")
