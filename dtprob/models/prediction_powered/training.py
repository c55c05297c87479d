"""Train the predictors that a scheme needs, and put them to work: from labels and features to a `Sample`."""

import copy
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.models.prediction_powered.predictors import JaxPredictor, Trainable
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.schemes import named_scheme

_ROWS: Final = 65_536

type Predictor = Trainable | JaxPredictor


def assign_folds(key: PRNGKeyArray, n: int, folds: int) -> Int[np.ndarray, " sample"]:
    """A random fold for each sample, their sizes differing by one at most.

    Raises:
        InputError: fewer than 2 folds, or fewer samples than folds.
    """
    if folds < 2:
        raise InputError("folds", "2 or more", str(folds), "Use scheme ppi for one predictor")
    if n < folds:
        remedy = f"Use {max(n, 2)} folds or fewer, or label more samples"
        raise InputError("labelled samples", f"at least one per fold ({folds})", str(n), remedy)
    return np.asarray(jax.random.permutation(key, jnp.arange(n) % folds))


def train(
    key: PRNGKeyArray,
    scheme: str,
    predictor: Predictor,
    *,
    x: Float[np.ndarray, "sample feature"],
    y: np.ndarray,
    x_unlabelled: Any,
    folds: int = 5,
    features: np.ndarray | None = None,
    features_unlabelled: Any = None,
    probability: bool = False,
    **rest: Any,
) -> Sample:
    """The sample that a scheme infers from, its predictors trained.

    Args:
        key: typed JAX key, for folds, splits and initial parameters.
        scheme: "erm" trains nothing; "ss" one predictor on all labels; "ppi" and "tuned_ppi" one on a random
            half, and keep the other half as labels; "cppi" and "tuned_cppi" one per fold, on all the others.
        predictor: an object with fit and predict, of which copies are trained, or a `JaxPredictor`.
        x: what the predictor sees of the labelled samples.
        y: labels.
        x_unlabelled: what it sees of the unlabelled samples, cut by slices.
        folds: number of folds.
        features: what the loss sees of the labelled samples; None where it needs no features.
        features_unlabelled: likewise of the unlabelled samples.
        probability: predict the probability of label 1 with predict_proba.
        rest: further fields of `Sample`, such as weights; a cluster is kept in one fold or half.

    Raises:
        InputError: fewer labels than folds, one label to split, a fold whose training labels are all of one class,
            features that do not fit together.
    """
    chosen = named_scheme(scheme)
    whole = {"features": features, "x_unlabelled": features_unlabelled, **rest}
    Sample(x=x, y=y, x_unlabelled=x_unlabelled, prediction_unlabelled=None)
    x, y = np.asarray(x), np.asarray(y)
    empty = x_unlabelled is None or len(x_unlabelled) == 0
    if chosen.training == "none" or empty:
        return _sample(whole, np.arange(len(y)), y, None, None)
    keys = jax.random.split(key)
    unit = (
        np.arange(len(y))
        if rest.get("cluster") is None
        else np.unique(rest["cluster"], return_inverse=True)[1]
    )
    units = 1 + int(unit.max())
    if chosen.training == "split":
        if units < 2:
            remedy = "Label more samples, or use scheme erm"
            raise InputError("labelled samples", "2 or more, half of which train", str(units), remedy)
        half = np.asarray(jax.random.permutation(keys[0], units))
        chosen_units = np.zeros(units, bool)
        chosen_units[half[: units // 2]] = True
        inside = chosen_units[unit]
        masks, kept = inside[None], np.flatnonzero(~inside)
    elif chosen.training == "all":
        masks, kept = np.ones((1, len(y)), bool), np.arange(len(y))
    else:
        fold = assign_folds(keys[0], units, folds)[unit]
        masks, kept = fold != np.arange(folds)[:, None], np.arange(len(y))
    _check_classes(y, masks, probability=probability)
    asked = _trained(keys[1], predictor, x, y, masks, probability=probability)
    own = np.stack([part(x) for part in asked], axis=1)
    out_of_fold = own[:, 0] if len(masks) == 1 else own[np.arange(len(y)), fold_of(masks)]
    return _sample(whole, kept, y[kept], out_of_fold[kept], _chunked(asked, x_unlabelled))


def fold_of(masks: np.ndarray) -> Int[np.ndarray, " sample"]:
    """For each sample, the first predictor that did not see it."""
    return np.argmin(masks, axis=0)


def _sample(
    whole: dict[str, Any], kept: np.ndarray, y: np.ndarray, prediction: Any, unlabelled: Any
) -> Sample:
    features, rest = whole["features"], {k: v for k, v in whole.items() if k != "features"}
    for name in ("weight", "context", "cluster"):
        if rest.get(name) is not None:
            rest[name] = np.asarray(rest[name])[kept]
    x = None if features is None else np.asarray(features)[kept]
    return Sample(x=x, y=y, prediction=prediction, prediction_unlabelled=unlabelled, **rest)


def _check_classes(y: np.ndarray, masks: np.ndarray, *, probability: bool) -> None:
    if not probability:
        return
    for number, mask in enumerate(masks):
        classes = np.unique(y[mask])
        if len(classes) < 2:
            got = f"only {classes[0]:g}" if len(classes) else "none"
            remedy = "Use fewer folds, or label more samples of the other class"
            what = f"training labels of fold {number}"
            raise InputError(what, "both classes", got, remedy)


def _trained(
    key: PRNGKeyArray,
    predictor: Predictor,
    x: np.ndarray,
    y: np.ndarray,
    masks: np.ndarray,
    *,
    probability: bool,
) -> list[Any]:
    """For each mask, the function that predicts from features."""
    if isinstance(predictor, JaxPredictor):
        return _trained_at_once(key, predictor, jnp.asarray(x), jnp.asarray(y), jnp.asarray(masks))
    if not isinstance(predictor, Trainable):
        got = f"an object of type {type(predictor).__name__}"
        remedy = "Give it methods fit and predict, or use Neural"
        raise InputError("predictor", "methods fit and predict, or a JaxPredictor", got, remedy)
    found: list[Any] = []
    for mask in masks:
        one: Any = copy.deepcopy(predictor)
        one.fit(x[mask], y[mask])
        found.append(_probability(one) if probability else one.predict)
    return [lambda rows, ask=ask: np.asarray(ask(rows), float) for ask in found]


def _probability(trained: Any) -> Any:
    if not hasattr(trained, "predict_proba"):
        got = f"{type(trained).__name__} without predict_proba"
        raise InputError("predictor", "a classifier that tells probabilities", got, "Use another one")
    return lambda rows: trained.predict_proba(rows)[:, 1]


def _trained_at_once(
    key: PRNGKeyArray, predictor: JaxPredictor, x: Array, y: Array, masks: Array
) -> list[Any]:
    keys = jax.random.split(key, len(masks))
    y = y.astype(jnp.result_type(y, x, float))
    learned = jax.jit(jax.vmap(predictor.train, (0, None, None, 0)))(keys, x, y, masks.astype(y.dtype))
    asked = jax.jit(predictor.predict)

    def ask(number: int) -> Any:
        own = jax.tree.map(lambda leaf: leaf[number], learned)
        return lambda rows: np.asarray(asked(own, jnp.asarray(rows)))

    return [ask(number) for number in range(len(masks))]


def _chunked(asked: list[Any], x_unlabelled: Any) -> np.ndarray:
    """The predictions of all predictors for all unlabelled samples, (N, K, *label)."""
    rows = range(0, len(x_unlabelled), _ROWS)
    parts = [np.stack([ask(x_unlabelled[i : i + _ROWS]) for ask in asked], axis=1) for i in rows]
    return np.concatenate(parts)
