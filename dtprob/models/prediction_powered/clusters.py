"""Samples that come in clusters, such as positions along a route: what counts as one is the sum over a cluster.

A cluster adds to the error of the corrected loss what its labelled and its unlabelled samples add together, each about
their mean; clusters are independent, samples of one need not be (Liang and Zeger, Longitudinal data analysis
using generalized linear models, 1986).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dtprob.errors import InputError
from dtprob.models.prediction_powered.arrays import Values, namespace
from dtprob.models.prediction_powered.losses import AbstractLoss
from dtprob.models.prediction_powered.moments import Derivatives, Evaluation, over_predictors
from dtprob.models.prediction_powered.sample import Sample, averaged


class Sums(NamedTuple):
    """Weighted sums over the unlabelled samples of each cluster.

    Attributes:
        gradient: of the gradients at the predictions.
        weight: of the weights.
    """

    gradient: Float[np.ndarray, "cluster parameter"]
    weight: Float[np.ndarray, " cluster"]


def clustered(
    loss: AbstractLoss, sample: Sample, theta: Float[Values, " parameter"], evaluation: Evaluation
) -> Evaluation:
    """The evaluation with clusters in the place of labelled samples, each with its unlabelled ones in it.

    What is left for the unlabelled group has no covariance of its own.

    Args:
        loss: the loss.
        sample: the data, with clusters.
        theta: where the data were evaluated.
        evaluation: sample by sample.
    """
    labelled, rest = sample.clusters
    count = 1 + max(labelled.max(), rest.max(initial=-1))
    weight = _totals(labelled, sample.labelled_weight, count) / sample.n
    gradient, predicted = (
        _about_mean(_totals(labelled, np.asarray(rows), count) / sample.n, weight)
        for rows in (evaluation.gradient, evaluation.predicted_gradient)
    )
    group = evaluation.unlabelled
    if sample.has_predictions:
        sums = _unlabelled(loss, sample, theta, rest, count)
        predicted = predicted - _about_mean(
            sums.gradient / sample.n_unlabelled, sums.weight / sample.n_unlabelled
        )
        group = group._replace(
            second=group.gradient[:, :, None] * group.gradient[:, None, :], twice=None, square=None
        )
    xp = namespace(theta)
    return evaluation._replace(
        unlabelled=group,
        gradient=xp.asarray(count * gradient),
        predicted_gradient=xp.asarray(count * predicted),
        context=xp.zeros(count, int),
        n=xp.asarray(float(count)),
        weight=xp.asarray(count * weight),
    )


def cluster_weights(sample: Sample) -> Float[np.ndarray, " cluster"]:
    """Total weight of the labelled samples in each cluster, of each sample where there are no clusters."""
    if sample.cluster is None:
        return sample.labelled_weight
    labelled = sample.clusters[0]
    return _totals(labelled, sample.labelled_weight, 1 + labelled.max())


def check_clusters(sample: Sample, *, pooled: bool, what: str = "") -> None:
    """Refuse what does not know of clusters.

    Args:
        sample: the data.
        pooled: whether labels and predictions are averaged as if alike.
        what: what else is asked for that takes samples one by one; "" for nothing.

    Raises:
        InputError: a sample with clusters under a pooled scheme or such a demand, or with all labels in one of them.
    """
    if sample.cluster is None:
        return
    if pooled or what:
        remedy = "Leave cluster out, with intervals that are too narrow, or ask for another"
        raise InputError("cluster", "samples one by one", f"clusters with {what or 'scheme ss'}", remedy)
    if len(np.unique(sample.cluster)) == 1:
        raise InputError("cluster", "labels in 2 clusters or more", "1", "Label samples of other clusters")


def _totals(code: Int[np.ndarray, " sample"], rows: np.ndarray, count: int) -> np.ndarray:
    total = np.zeros((count, *rows.shape[1:]))
    np.add.at(total, code, rows)
    return total


def _about_mean(
    total: Float[np.ndarray, "cluster parameter"], weight: Float[np.ndarray, " cluster"]
) -> Float[np.ndarray, "cluster parameter"]:
    """What each cluster adds to the error of a mean that is divided by the total weight."""
    return total - weight[:, None] * total.sum(axis=0)


def _unlabelled(
    loss: AbstractLoss, sample: Sample, theta: Any, code: Int[np.ndarray, " sample"], count: int
) -> Sums:
    derivatives, start = Derivatives.of(loss), 0
    found = Sums(np.zeros((count, len(theta))), np.zeros(count))
    blocks = sample.blocks() if loss.traits.numpy else sample.chunks(averaged=loss.traits.linear_in_label)
    for x, prediction, weight, _ in blocks:
        given = averaged(prediction) if derivatives.linear_in_label else prediction
        rows = np.asarray(over_predictors(lambda y, x=x: derivatives.gradients(theta, x, y), given))
        here = code[start : start + len(rows)]
        weights = np.asarray(weight)[: len(here)]
        np.add.at(found.gradient, here, weights[:, None] * rows[: len(here)])
        np.add.at(found.weight, here, weights)
        start += len(here)
    return found
