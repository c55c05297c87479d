"""Labelled and unlabelled samples of known law, with predictors from perfect to misleading, for studies.

Features are standard normal, the label is linear in them plus noise, predictors are linear. The mean and the
scatter of the unlabelled features are drawn from their exact laws (normal and Wishart), so that a study with
many unlabelled samples costs no more than one with few.
"""

from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

type Quality = Literal["perfect", "good", "useless", "overfitted", "anti-correlated"]

FEATURES = 7
SIGNAL = 4.1
NOISE = 1.29
USELESS = 15.5
QUALITIES: tuple[Quality, ...] = get_args(Quality.__value__)


class LabelStudy(NamedTuple):
    """One data set; the label's mean over the population is 0.

    Attributes:
        y: labels.
        prediction: of each labelled sample, by the predictor that did not see its label.
        fold: of each labelled sample.
        unlabelled_mean: over unlabelled samples, of the predictors' average.
        unlabelled_square: likewise of its square.
    """

    y: Float[Array, " sample"]
    prediction: Float[Array, " sample"]
    fold: Int[Array, " sample"]
    unlabelled_mean: Float[Array, ""]
    unlabelled_square: Float[Array, ""]


class Setting(NamedTuple):
    """What kind of data set.

    Attributes:
        quality: "perfect" (the label is a function of the features, and predicted), "good" (least squares on
            the other folds), "useless" (a direction of the features that is uncorrelated with the label),
            "overfitted" (least squares on labels that have nothing to do with the features), "anti-correlated"
            (good, negated).
        n: labelled samples.
        unlabelled: unlabelled samples, more than there are features.
        folds: number of folds.
    """

    quality: Quality
    n: int
    unlabelled: int | Float[Array, ""]
    folds: int


def label_study(key: PRNGKeyArray, setting: Setting) -> LabelStudy:
    """Draw one data set."""
    quality, n, count, folds = setting
    keys = jax.random.split(key, 3)
    x = jax.random.normal(keys[0], (n, FEATURES))
    noise = jax.random.normal(keys[1], (n,))
    signal = jnp.full(FEATURES, jnp.sqrt(SIGNAL / FEATURES))
    total = jnp.sqrt((SIGNAL + NOISE) / SIGNAL)
    fold = jnp.arange(n) % folds
    if quality == "perfect":
        y = total * x @ signal
        predictors = jnp.tile(jnp.concatenate([jnp.zeros(1), total * signal]), (folds, 1))
    elif quality == "useless":
        y = x @ signal + jnp.sqrt(NOISE) * noise
        other = jnp.zeros(FEATURES).at[0].set(1.0).at[1].set(-1.0) * jnp.sqrt(USELESS / 2)
        predictors = jnp.tile(jnp.concatenate([jnp.zeros(1), other]), (folds, 1))
    else:
        y = jnp.sqrt(SIGNAL + NOISE) * noise
        if quality != "overfitted":
            y = x @ signal + jnp.sqrt(NOISE) * noise
        seen = (fold != jnp.arange(folds)[:, None]).astype(x.dtype)
        predictors = jax.vmap(lambda weight: _least_squares(x, y, weight))(seen)
        predictors = -predictors if quality == "anti-correlated" else predictors
    return _predicted(x, y, fold, predictors, _unlabelled(keys[2], count))


def _predicted(
    x: Array, y: Array, fold: Array, predictors: Array, unlabelled: tuple[Array, Array]
) -> LabelStudy:
    mean, scatter = unlabelled
    own = predictors[fold]
    average = jnp.sum(predictors, axis=0) / len(predictors)
    center = average[0] + jnp.sum(average[1:] * mean)
    square = center**2 + average[1:] @ scatter @ average[1:]
    return LabelStudy(y, own[:, 0] + jnp.sum(own[:, 1:] * x, axis=1), fold, center, square)


def _least_squares(x: Array, y: Array, weight: Array) -> Float[Array, " coefficient"]:
    design = jnp.concatenate([jnp.ones((len(x), 1), x.dtype), x], axis=1)
    gram = (design * weight[:, None]).T @ design
    return jnp.linalg.solve(gram + 1e-9 * jnp.eye(len(gram)), (design * weight[:, None]).T @ y)


def _unlabelled(
    key: PRNGKeyArray, count: int | Float[Array, ""]
) -> tuple[Float[Array, " feature"], Float[Array, "feature feature"]]:
    """Mean of the features, and their mean outer product around it, by Bartlett's decomposition."""
    keys = jax.random.split(key, 3)
    mean = jax.random.normal(keys[0], (FEATURES,)) / jnp.sqrt(count)
    below = jnp.tril(jax.random.normal(keys[1], (FEATURES, FEATURES)), -1)
    degrees = (count - 1 - jnp.arange(FEATURES)) / 2
    root = below + jnp.diag(jnp.sqrt(2 * jax.random.gamma(keys[2], degrees)))
    return mean, root @ root.T / count
