"""What a sample must be: real, finite, there, and of shapes that fit together; or one line that says what to do."""

from typing import Any

import numpy as np

from dtprob.errors import InputError


def prediction_shape(shape: tuple[int, ...], count: int, label: tuple[int, ...]) -> tuple[int, ...]:
    """The shape (sample, fold, *label) of given predictions."""
    if shape == (count, *label):
        return count, 1, *label
    if len(shape) == 2 + len(label) and shape[0] == count and shape[2:] == label:
        return shape
    expected = f"shape {(count, *label)}, or a further axis of predictors after the first"
    raise InputError("prediction_unlabelled", expected, str(shape), "Give a prediction per unlabelled sample")


def check_predictors(predictors: int, count: int, n: int) -> None:
    """Refuse more predictors than one could train: axes in the wrong order would pass for samples without spread."""
    if predictors > 1 and predictors > min(count, n):
        expected = f"axes (sample, predictor), of {n} labels no more than {n} predictors"
        got = f"{predictors} predictors of {count} samples"
        raise InputError("prediction_unlabelled", expected, got, "Transpose it")


def real(name: str, array: np.ndarray) -> np.ndarray:
    """As numbers with a fraction, so that a mean of whole numbers or of yes and no is right."""
    if array.dtype.kind not in "fiub":
        raise InputError(name, "real numbers", f"values of type {array.dtype}", f"Give {name} as numbers")
    return array.astype(np.result_type(array.dtype, np.float32), copy=False)


def finite(name: str, array: np.ndarray) -> np.ndarray:
    """As `real`, and refuse NaN and infinity with the first index."""
    array = real(name, array)
    bad = ~np.isfinite(array)
    if bad.any():
        place = tuple(int(i) for i in np.argwhere(bad)[0])
        shown = place[0] if len(place) == 1 else place
        got = f"{array[place]} at index {shown}"
        raise InputError(name, "finite numbers", got, _without(name))
    return array


def check_mask(name: str, value: Any) -> None:
    """Refuse what is masked: as plain numbers it would count."""
    if np.ma.is_masked(value):
        first = int(np.argwhere(np.ma.getmaskarray(value))[0][0])
        raise InputError(name, "values that are there", f"a masked one in row {first}", _without(name))


def _without(name: str) -> str:
    """What to do about a sample that lacks a value."""
    return "Move samples without a label to the unlabelled ones" if name == "y" else "Remove the sample"


def check_columns(x: Any, other: Any) -> None:
    """Refuse data frames whose columns differ, also in order."""
    own, others = getattr(x, "columns", None), getattr(other, "columns", None)
    if own is not None and others is not None and list(own) != list(others):
        remedy = "Give labelled and unlabelled samples the same features, in the same order"
        raise InputError("x_unlabelled", f"columns {list(own)}, as x has", str(list(others)), remedy)


def matrix(name: str, value: Any, count: int, *, convert: bool = True) -> Any:
    """As an array of one row of features per sample; without `convert` only its shape is looked at."""
    array = np.asarray(value) if convert else value
    if len(array.shape) != 2 or array.shape[0] != count:
        got = f"shape {tuple(array.shape)}"
        raise InputError(name, f"shape ({count}, feature)", got, "Give one row per sample")
    return array


def weights(name: str, value: Any, count: int) -> np.ndarray | None:
    """Scaled to mean 1; refuse what is below 0 or all 0."""
    if value is None:
        return None
    weight = np.asarray(value, float)
    if weight.shape != (count,):
        raise InputError(name, f"shape ({count},)", str(weight.shape), "Give one weight per sample")
    bad = ~(weight >= 0) | ~np.isfinite(weight)
    if bad.any():
        first = int(np.argmax(bad))
        got = f"{weight[first]:g} at index {first}"
        raise InputError(name, "weights from 0 up", got, "Give the weight of a sample, not its difference")
    if not weight.sum() > 0:
        raise InputError(name, "a weight above 0", "zeros only", "Give the samples that count a weight")
    return weight / weight.mean()


def contexts(name: str, value: Any, count: int) -> np.ndarray | None:
    """Whole numbers from 0, one per sample."""
    if value is None:
        return None
    context = np.asarray(value)
    if context.shape != (count,) or context.dtype.kind not in "iu" or (count and context.min() < 0):
        got = f"shape {context.shape}, type {context.dtype}"
        remedy = "Number the contexts from 0"
        raise InputError(name, f"shape ({count},), whole numbers from 0", got, remedy)
    return context


def clusters(name: str, value: Any, count: int) -> np.ndarray | None:
    """Numbers or names, one per sample."""
    if value is None:
        return None
    cluster = np.asarray(value)
    if cluster.dtype.kind == "O":
        cluster = cluster.astype(str)
    if cluster.shape != (count,) or cluster.dtype.kind not in "iuU":
        got = f"shape {cluster.shape}, type {cluster.dtype}"
        raise InputError(name, f"shape ({count},), whole numbers or names", got, "Name each sample's cluster")
    return cluster


def check_both(cluster: Any, other: Any, has_predictions: bool, n_context: int) -> None:
    """See that clusters are told of all samples in one way, and that there are no contexts beside them."""
    if cluster is None and other is None:
        return
    if cluster is None or (has_predictions and other is None):
        missing = "cluster" if cluster is None else "cluster_unlabelled"
        remedy = "Give both; a sample that depends on no other is a cluster of its own"
        raise InputError(missing, "clusters of labelled and unlabelled samples", "none", remedy)
    if other is not None and (cluster.dtype.kind == "U") != (other.dtype.kind == "U"):
        got = f"{cluster.dtype} and {other.dtype}"
        raise InputError("cluster_unlabelled", "names or numbers, as cluster has", got, "Name them alike")
    if n_context > 1:
        raise InputError("cluster", "one context", f"{n_context} contexts", "Give either of the two")
