"""Bootstrap intervals whose cost does not grow with the number of resamples times that of unlabelled samples.

Labelled samples are resampled as they are. So are unlabelled ones while they are few; the sum over a resample
of many is drawn from the normal law with that sum's exact mean and covariance. A resample's estimate is one
Newton step from the estimate, with the resample's own gradient and second derivative: exact for quadratic
losses (Davidson and MacKinnon, Bootstrap testing in nonlinear models, 1999). Predictors are not trained anew,
and lambda is kept, as in PPBoot (Zrnic, 2024).
"""

from collections.abc import Generator, Iterator
from dataclasses import replace
from typing import Any, Final, Literal, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from scipy import linalg

from dtprob.errors import InputError
from dtprob.models.prediction_powered.arrays import Values
from dtprob.models.prediction_powered.clusters import check_clusters
from dtprob.models.prediction_powered.losses import AbstractLoss, named_loss
from dtprob.models.prediction_powered.moments import (
    Derivatives,
    Group,
    each_part,
    evaluate,
    group_sums,
    labelled_rows,
)
from dtprob.models.prediction_powered.quantile import Quantile, quantile_problem
from dtprob.models.prediction_powered.result import Estimate
from dtprob.models.prediction_powered.sample import Chunk, Sample, averaged
from dtprob.models.prediction_powered.schemes import Mix

_FEW: Final = 4096
_NUMBERS: Final = 4_000_000

type Method = Literal["percentile", "basic"]


class Means(NamedTuple):
    """Mean gradient and second derivative of a group in each resample, per context."""

    gradient: Float[np.ndarray, "draw context parameter"]
    hessian: Float[np.ndarray, "draw context parameter parameter"]


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
    check_clusters(sample, pooled=False, what="the bootstrap")
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
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    if isinstance(loss, Quantile):
        return _quantile_draws(random, loss, sample, estimate, draws)
    chosen = named_loss(loss)
    theta = np.asarray(estimate.theta)
    true, predicted = labelled_rows(sample)
    mix, unlabelled = _mix(sample, estimate), _unlabelled_means(random, chosen, sample, theta, draws)
    parts: list[np.ndarray] = []
    for rows in _batches(sample.n, len(theta), draws):
        groups = (true, 1), (predicted, sample.n_context)
        own = _resampled(random, chosen, theta, groups, rows.stop - rows.start)
        parts.append(theta - _steps(mix, own[0], own[1], Means(*(part[rows] for part in unlabelled))))
    return np.concatenate(parts)


def _batches(size: int, dimension: int, draws: int) -> Generator[slice]:
    """Which resamples of `size` things are held at a time."""
    batch = max(1, _NUMBERS // (size * (dimension + 1)))
    for start in range(0, draws, batch):
        yield slice(start, min(start + batch, draws))


def resample(random: np.random.Generator, size: int) -> Int[np.ndarray, " size"]:
    """How often each of `size` things is in a resample."""
    return np.bincount(random.integers(0, size, size, dtype=np.int32), minlength=size)


def _mix(sample: Sample, estimate: Estimate) -> Mix:
    lam = np.asarray(estimate.lam.value)
    n, count = np.asarray(float(sample.n)), np.asarray(float(sample.n_unlabelled))
    return estimate.scheme.mix(n, count, np.broadcast_to(lam, (len(lam), sample.n_context)))


def _resampled(
    random: np.random.Generator,
    loss: AbstractLoss,
    theta: Float[np.ndarray, " parameter"],
    groups: tuple[tuple[Chunk, int], ...],
    draws: int,
) -> list[Means]:
    """Means over resamples of some samples, for each of several groups of what is known of them.

    Each group comes with its number of contexts. A loss that takes NumPy's arrays is asked resample by
    resample, whose weights then stay in the processor's cache.
    """
    size = len(groups[0][0].weight)
    counts = (resample(random, size) for _ in range(draws))
    if loss.traits.numpy:
        with np.errstate(all="ignore"):
            return _one_by_one(loss, theta, groups, counts)
    table = np.stack(list(counts))
    found = (_at_once(loss, theta, rows, table * rows.weight, number) for rows, number in groups)
    return [Means(*(np.asarray(part) for part in means)) for means in found]


def _one_by_one(
    loss: AbstractLoss,
    theta: Float[np.ndarray, " parameter"],
    groups: tuple[tuple[Chunk, int], ...],
    counts: Iterator[Int[np.ndarray, " sample"]],
) -> list[Means]:
    hessian = Derivatives.of(loss).hessian
    labels = [averaged(rows.prediction)[:, 0] for rows, _ in groups]
    gradients = [loss.gradients(theta, rows.x, y) for (rows, _), y in zip(groups, labels, strict=True)]
    found: list[list[tuple[list[Any], list[Any]]]] = [[] for _ in groups]
    for count in counts:
        for (rows, number), y, gradient, means in zip(groups, labels, gradients, found, strict=True):
            weight = count * rows.weight
            weight /= weight.sum()
            inside = [weight * (rows.context == i) for i in range(number)] if number > 1 else [weight]
            hessians = [hessian(theta, rows.x, y, part) for part in inside]
            means.append(([part @ gradient for part in inside], hessians))
    return [Means(*(np.array(part) for part in zip(*means, strict=True))) for means in found]


@eqx.filter_jit
def _at_once(
    loss: AbstractLoss,
    theta: Float[Values, " parameter"],
    rows: Chunk,
    weights: Float[Values, "draw sample"],
    n_context: int,
) -> tuple[Values, Values]:
    def one(weight: Values) -> Group:
        return group_sums(loss, theta, rows._replace(weight=weight / weight.sum()), n_context)

    group = jax.vmap(one)(weights)
    return group.gradient, group.hessian


def _unlabelled_means(
    random: np.random.Generator,
    loss: AbstractLoss,
    sample: Sample,
    theta: Float[np.ndarray, " parameter"],
    draws: int,
) -> Means:
    if sample.has_predictions and sample.n_unlabelled <= _FEW:
        rows = Chunk(*(np.concatenate(parts) for parts in zip(*sample.blocks(), strict=True)))
        parts = [
            _resampled(random, loss, theta, ((rows, sample.n_context),), some.stop - some.start)[0]
            for some in _batches(sample.n_unlabelled, len(theta), draws)
        ]
        return Means(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    group = each_part(np.asarray, evaluate(loss, sample, theta).unlabelled)
    n_context, d = group.gradient.shape
    mean = group.gradient.reshape(-1)
    outer = np.outer(mean, group.offset.reshape(-1))
    covariance = linalg.block_diag(*group.second) - (outer + outer.T)
    size, vectors = np.linalg.eigh(covariance / max(sample.n_unlabelled, 1))
    noise = random.standard_normal((draws, len(mean))) * np.sqrt(np.maximum(size, 0.0))
    gradient = (mean + noise @ vectors.T).reshape(draws, n_context, d)
    return Means(np.asarray(gradient), np.broadcast_to(group.hessian, (draws, n_context, d, d)))


def _steps(mix: Mix, true: Means, predicted: Means, unlabelled: Means) -> Float[np.ndarray, "draw parameter"]:
    """The Newton step of each resample; with a lambda per parameter, each from its own corrected loss."""
    true_share = float(mix.true)

    def step(plus: Float[np.ndarray, " context"], minus: Float[np.ndarray, " context"]) -> np.ndarray:
        def total(part: int) -> np.ndarray:
            corrected = np.tensordot(unlabelled[part], plus, ([1], [0]))
            return (
                true_share * true[part][:, 0] + corrected - np.tensordot(predicted[part], minus, ([1], [0]))
            )

        return np.linalg.solve(total(1), total(0)[..., None])[..., 0]

    weights = np.concatenate([np.asarray(mix.unlabelled), np.asarray(mix.predicted)], axis=1)
    different, which = np.unique(weights, axis=0, return_inverse=True)
    found = np.stack([step(*np.split(row, 2)) for row in different])
    return found[which.reshape(-1), :, np.arange(len(weights))].T


def _quantile_draws(
    random: np.random.Generator, loss: Quantile, sample: Sample, estimate: Estimate, draws: int
) -> Float[np.ndarray, "draw parameter"]:
    """Woodruff's way: the distribution function is resampled at the estimate and inverted around it."""
    problem = quantile_problem(loss, sample, estimate.scheme)
    mix = true, unlabelled, predicted = problem.mix(estimate.lam)
    theta = float(estimate.theta[0])
    prediction = sample.y if sample.prediction is None else sample.prediction
    step = true * (sample.y <= theta) - predicted * (prediction <= theta)
    counts = np.stack([resample(random, sample.n) for _ in range(draws)]) * sample.labelled_weight
    labelled = counts @ step / counts.sum(axis=1)
    variance = problem.unlabelled_variance(theta)
    noise = random.standard_normal(draws) * np.sqrt(variance)
    shift = labelled - sample.labelled_weight @ step / sample.n + unlabelled * noise
    return problem.minimisers(mix, loss.level - shift)[:, None]
