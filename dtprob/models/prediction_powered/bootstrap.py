"""Bootstrap intervals whose cost does not grow with the number of resamples times that of unlabelled samples.

Labelled samples are resampled as they are. So are unlabelled ones while they are few; the sum over a resample
of many is drawn from the normal law with that sum's exact mean and covariance. A resample's estimate is one
Newton step from the estimate, with the resample's own gradient and second derivative: exact for quadratic
losses (Davidson and MacKinnon, Bootstrap testing in nonlinear models, 1999). Predictors are not trained anew,
and lambda is kept, as in PPBoot (Zrnic, 2024).
"""

from collections.abc import Generator
from dataclasses import replace
from typing import Final, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.models.prediction_powered.losses import AbstractLoss, named_loss
from dtprob.models.prediction_powered.moments import Group, evaluate, group_sums, labelled_rows
from dtprob.models.prediction_powered.quantile import Quantile, quantile_problem
from dtprob.models.prediction_powered.result import Estimate
from dtprob.models.prediction_powered.sample import Chunk, Sample
from dtprob.models.prediction_powered.schemes import Mix

_FEW: Final = 4096
_NUMBERS: Final = 4_000_000

type Method = Literal["percentile", "basic"]


class Means(NamedTuple):
    """Mean gradient and second derivative of a group in each resample, per context."""

    gradient: Float[Array, "draw context parameter"]
    hessian: Float[Array, "draw context parameter parameter"]


def bootstrap(
    key: PRNGKeyArray,
    loss: str | AbstractLoss | Quantile,
    sample: Sample,
    estimate: Estimate,
    *,
    draws: int = 1000,
    method: Method = "percentile",
    level: float | None = None,
) -> Estimate:
    """The estimate with bootstrap intervals and covariance.

    Args:
        key: typed JAX key.
        loss: as in `estimate`.
        sample: as in `estimate`.
        estimate: what it gave.
        draws: number of resamples.
        method: "percentile" takes quantiles of the resamples' estimates, "basic" mirrors them.
        level: of the intervals; the estimate's own by default.

    Raises:
        InputError: fewer than 2 draws, an unknown method.
    """
    if draws < 2 or method not in ("percentile", "basic"):
        got = f"{draws} draws, method {method!r}"
        raise InputError("bootstrap", "2 or more draws, method percentile or basic", got, "Correct them")
    level = estimate.level if level is None else level
    resampled = bootstrap_draws(key, loss, sample, estimate, draws)
    low, high = np.quantile(resampled, [(1 - level) / 2, (1 + level) / 2], axis=0)
    if method == "basic":
        low, high = 2 * estimate.theta - high, 2 * estimate.theta - low
    covariance = np.atleast_2d(np.cov(resampled.T))
    return replace(estimate, low=low, high=high, level=level, covariance=covariance)


def bootstrap_draws(
    key: PRNGKeyArray, loss: str | AbstractLoss | Quantile, sample: Sample, estimate: Estimate, draws: int
) -> Float[np.ndarray, "draw parameter"]:
    """The estimates of the resamples."""
    if isinstance(loss, Quantile):
        return _quantile_draws(key, loss, sample, estimate, draws)
    chosen, theta = named_loss(loss), jnp.asarray(estimate.theta)
    keys = jax.random.split(key)
    true, predicted = labelled_rows(sample)
    unlabelled = _unlabelled_means(keys[1], chosen, sample, theta, draws)

    def estimates(counts: Array, means: Means) -> Array:
        groups = (
            _resampled(chosen, theta, true, counts, 1),
            _resampled(chosen, theta, predicted, counts, sample.n_context),
        )
        return theta - _steps(_mix(sample, estimate), *groups, means)

    return np.concatenate(
        [
            np.asarray(estimates(counts, Means(unlabelled.gradient[rows], unlabelled.hessian[rows])))
            for rows, counts in _batches(keys[0], sample.n, len(theta), draws)
        ]
    )


def _batches(key: PRNGKeyArray, size: int, dimension: int, draws: int) -> Generator[tuple[slice, Array]]:
    """Resamples of `size` things, a bounded amount at a time: which draws, and their counts."""
    batch = max(1, _NUMBERS // (size * (dimension + 1)))
    for number, start in enumerate(range(0, draws, batch)):
        rows = slice(start, min(start + batch, draws))
        yield rows, resample(jax.random.fold_in(key, number), size, rows.stop - rows.start)


def resample(key: PRNGKeyArray, size: int, draws: int) -> Float[Array, "draw size"]:
    """How often each of `size` things is in each of `draws` resamples."""
    index = np.asarray(jax.random.randint(key, (draws, size), 0, size))
    index = index + size * np.arange(draws)[:, None]
    counts = np.bincount(index.ravel(), minlength=draws * size)
    return jnp.asarray(counts.reshape(draws, size), float)


def _mix(sample: Sample, estimate: Estimate) -> Mix:
    lam = jnp.asarray(estimate.lam.value)
    n, count = jnp.asarray(float(sample.n)), jnp.asarray(float(sample.n_unlabelled))
    return estimate.scheme.mix(n, count, jnp.broadcast_to(lam, (len(lam), sample.n_context)))


@eqx.filter_jit
def _resampled(
    loss: AbstractLoss,
    theta: Float[Array, " parameter"],
    rows: Chunk,
    counts: Float[Array, "draw sample"],
    n_context: int,
) -> Means:
    def one(count: Array) -> Group:
        weight = count * rows.weight
        share = weight / jnp.sum(weight)
        return group_sums(loss, theta, rows._replace(weight=share), n_context)

    group = jax.vmap(one)(counts)
    return Means(group.gradient, group.hessian)


def _unlabelled_means(
    key: PRNGKeyArray, loss: AbstractLoss, sample: Sample, theta: Float[Array, " parameter"], draws: int
) -> Means:
    if sample.has_predictions and sample.n_unlabelled <= _FEW:
        (chunk,) = sample.chunks()
        parts = [
            _resampled(loss, theta, chunk, counts, sample.n_context)
            for _, counts in _batches(key, sample.n_unlabelled, len(theta), draws)
        ]
        return Means(*(jnp.concatenate(part) for part in zip(*parts, strict=True)))
    group = evaluate(loss, sample, theta).unlabelled
    n_context, d = group.gradient.shape
    mean = group.gradient.reshape(-1)
    second = jax.scipy.linalg.block_diag(*group.second)
    size, vectors = jnp.linalg.eigh((second - jnp.outer(mean, mean)) / max(sample.n_unlabelled, 1))
    noise = jax.random.normal(key, (draws, len(mean)), mean.dtype) * jnp.sqrt(jnp.maximum(size, 0.0))
    gradient = (mean + noise @ vectors.T).reshape(draws, n_context, d)
    return Means(gradient, jnp.broadcast_to(group.hessian, (draws, n_context, d, d)))


@jax.jit
def _steps(mix: Mix, true: Means, predicted: Means, unlabelled: Means) -> Float[Array, "draw parameter"]:
    """The Newton step of each resample; with a lambda per parameter, each from its own corrected loss."""

    def step(plus: Float[Array, " context"], minus: Float[Array, " context"]) -> Array:
        def total(part: int) -> Array:
            corrected = jnp.tensordot(unlabelled[part], plus, ([1], [0]))
            return mix.true * true[part][:, 0] + corrected - jnp.tensordot(predicted[part], minus, ([1], [0]))

        return jnp.linalg.solve(total(1), total(0)[..., None])[..., 0]

    each = jax.vmap(step, out_axes=1)(mix.unlabelled, mix.predicted)
    return jnp.diagonal(each, axis1=1, axis2=2)


def _quantile_draws(
    key: PRNGKeyArray, loss: Quantile, sample: Sample, estimate: Estimate, draws: int
) -> Float[np.ndarray, "draw parameter"]:
    """Woodruff's way: the distribution function is resampled at the estimate and inverted around it."""
    problem = quantile_problem(loss, sample, estimate.scheme)
    true, unlabelled, predicted = problem.mix(estimate.lam)
    theta = float(estimate.theta[0])
    prediction = sample.y if sample.prediction is None else sample.prediction
    step = true * (sample.y <= theta) - predicted * (prediction <= theta)
    keys = jax.random.split(key)
    counts = np.asarray(resample(keys[0], sample.n, draws)) * sample.labelled_weight
    labelled = counts @ step / counts.sum(axis=1)
    variance = problem.unlabelled_variance(theta)
    noise = np.asarray(jax.random.normal(keys[1], (draws,))) * np.sqrt(variance)
    shift = labelled - sample.labelled_weight @ step / sample.n + unlabelled * noise
    function = problem.steps.function(true, unlabelled, predicted)
    start = function[np.searchsorted(problem.steps.value, theta)]
    return _inverse(problem.steps.value, np.maximum.accumulate(function), start - shift)[:, None]


def _inverse(
    value: Float[np.ndarray, " value"],
    function: Float[np.ndarray, " value"],
    level: Float[np.ndarray, " draw"],
) -> Float[np.ndarray, " draw"]:
    index = np.searchsorted(function, level - 1e-12)
    return value[np.minimum(index, len(value) - 1)]
