"""What inference starts from: a few labelled samples, many unlabelled ones, and predictions for both."""

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, NamedTuple, final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dtprob.errors import InputError
from dtprob.models.prediction_powered.arrays import Values
from dtprob.models.prediction_powered.checks import (
    check_both,
    check_columns,
    check_mask,
    check_predictors,
    clusters,
    contexts,
    finite,
    matrix,
    prediction_shape,
    real,
    weights,
)

_CHUNK_NUMBERS: Final = 16_000_000
"""Numbers in a chunk of unlabelled data, 128 MB in double precision."""
_BLOCK_NUMBERS: Final = 9000
"""Numbers in a block; OpenBLAS shares out the product of a vector with a larger matrix among threads, which for
so little work costs more than it saves."""

type Predictor = Callable[[np.ndarray], np.ndarray]


class Chunk(NamedTuple):
    """Consecutive unlabelled samples; a chunk is filled with copies of its last row, of weight 0."""

    x: Float[Values, "sample feature"]
    prediction: Float[Values, "sample fold ..."]
    weight: Float[Values, " sample"]
    context: Int[Values, " sample"]


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Sample:
    """Labelled and unlabelled samples with predictions, checked when made.

    The unlabelled arrays may be anything that has a shape and is cut by slices (a NumPy or JAX array, a
    memory map, an HDF5 or Zarr array), or lists; they are read one chunk at a time, and held whole only if they fit in
    one.

    Attributes:
        y: labels, (n,) or (n, label).
        x: features of the labelled samples, (n, feature); None where the loss needs none (mean, quantile).
        prediction: predicted labels of the labelled samples, with the shape of y; each by a predictor that
            has not seen that sample's label.
        x_unlabelled: features, (N, feature).
        prediction_unlabelled: predicted labels, (N, *label), or (N, K, *label) by K predictors, or a function
            of a chunk of x_unlabelled that gives them.
        weight: of the labelled samples, not negative; scaled to mean 1.
        weight_unlabelled: of the unlabelled samples, likewise.
        context: for each labelled sample, which context it belongs to, 0, 1, ...; each context has a lambda
            of its own when tuning asks for it.
        context_unlabelled: likewise for the unlabelled samples.
        cluster: for each labelled sample, to which cluster (a route, a sweep, a day) it belongs, a number or a name;
            samples of one cluster may depend on each other, and the interval then counts clusters.
        cluster_unlabelled: likewise for the unlabelled samples; the same name is the same cluster.
        chunk: rows of a chunk; by default about 128 MB.

    Raises:
        InputError: shapes or columns that do not fit together, masked values, a single unlabelled sample, more
            predictors than samples, NaN or infinity among labels, features or predictions of labelled samples,
            negative weights.
    """

    y: np.ndarray
    x: np.ndarray | None = None
    prediction: np.ndarray | None = None
    x_unlabelled: Any = None
    prediction_unlabelled: Any = None
    weight: np.ndarray | None = None
    weight_unlabelled: np.ndarray | None = None
    context: np.ndarray | None = None
    context_unlabelled: np.ndarray | None = None
    cluster: np.ndarray | None = None
    cluster_unlabelled: np.ndarray | None = None
    chunk: int | None = None
    _whole: dict[str, Chunk] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        """Check everything that can be checked without a pass over the unlabelled data."""
        for name in (
            "y",
            "x",
            "prediction",
            "x_unlabelled",
            "prediction_unlabelled",
            "weight",
            "weight_unlabelled",
        ):
            check_mask(name, getattr(self, name))
        check_columns(self.x, self.x_unlabelled)
        if self.chunk is not None and self.chunk < 1:
            raise InputError("chunk", "1 or more rows", str(self.chunk), "Leave it out for about 128 MB")
        for name in ("x_unlabelled", "prediction_unlabelled"):
            if isinstance(getattr(self, name), (list, tuple)):
                self._set(name, np.asarray(getattr(self, name)))
        labels = np.asarray(self.y)
        if labels.ndim not in (1, 2) or not len(labels):
            got = f"shape {labels.shape}"
            raise InputError("y", "labels, shape (n,) or (n, label)", got, "Give one row per labelled sample")
        self._set("y", finite("y", labels))
        n = len(labels)
        x = np.zeros((n, 0)) if self.x is None else matrix("x", self.x, n)
        self._set("x", finite("x", x))
        self._set("weight", weights("weight", self.weight, n))
        self._set("context", contexts("context", self.context, n))
        self._set("cluster", clusters("cluster", self.cluster, n))
        if self.prediction is not None:
            prediction = np.asarray(self.prediction)
            if prediction.shape != labels.shape:
                remedy = "Give one prediction per labelled sample"
                raise InputError("prediction", f"shape {labels.shape}", str(prediction.shape), remedy)
            self._set("prediction", finite("prediction", prediction))
        self._check_unlabelled()

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def _check_unlabelled(self) -> None:
        count = self.n_unlabelled
        self._set("weight_unlabelled", weights("weight_unlabelled", self.weight_unlabelled, count))
        self._set("context_unlabelled", contexts("context_unlabelled", self.context_unlabelled, count))
        self._set("cluster_unlabelled", clusters("cluster_unlabelled", self.cluster_unlabelled, count))
        check_both(self.cluster, self.cluster_unlabelled, self.has_predictions, self.n_context)
        if count == 0:
            return
        if self.x_unlabelled is not None:
            matrix("x_unlabelled", self.x_unlabelled, count, convert=False)
            width, expected = self.x_unlabelled.shape[1], self.features.shape[1]
            if width != expected:
                got = f"width {width}"
                remedy = "Give labelled and unlabelled samples the same features, in the same order"
                raise InputError("x_unlabelled", f"width {expected}, as x has", got, remedy)
        elif self.features.shape[1]:
            raise InputError("x_unlabelled", "features, as x has", "nothing", "Give x_unlabelled")
        if self.prediction_unlabelled is None:
            return
        if count == 1:
            remedy = "Give more, or leave it out: one sample does not tell how far predictions scatter"
            raise InputError("prediction_unlabelled", "2 or more samples", "1", remedy)
        if self.prediction is None:
            remedy = "Predict the labelled samples too, each without its own label"
            raise InputError("prediction", "predictions of the labelled samples", "nothing", remedy)
        if not callable(self.prediction_unlabelled):
            shape = prediction_shape(self.prediction_unlabelled.shape, count, self.y.shape[1:])
            check_predictors(shape[1], count, self.n)
        highest = -1 if self.context_unlabelled is None else int(self.context_unlabelled.max())
        if highest >= self.n_context:
            got = f"context {highest}"
            remedy = "Leave out contexts without labelled samples, or join them to others"
            raise InputError("context_unlabelled", f"contexts below {self.n_context}", got, remedy)

    @property
    def n(self) -> int:
        """Number of labelled samples."""
        return len(self.y)

    @property
    def n_unlabelled(self) -> int:
        """Number of unlabelled samples."""
        for array in (self.x_unlabelled, self.prediction_unlabelled):
            if array is not None and not callable(array):
                return int(array.shape[0])
        return 0

    @property
    def n_context(self) -> int:
        """Number of contexts."""
        return int(self.labelled_context.max()) + 1

    @property
    def has_predictions(self) -> bool:
        """Whether there are unlabelled samples with predictions."""
        return self.prediction_unlabelled is not None and self.n_unlabelled > 0

    @property
    def features(self) -> np.ndarray:
        """Features of the labelled samples, width 0 where there are none."""
        return np.zeros((self.n, 0)) if self.x is None else self.x

    @property
    def labelled_weight(self) -> np.ndarray:
        """Weights of the labelled samples, mean 1."""
        return np.ones(self.n) if self.weight is None else self.weight

    @property
    def labelled_context(self) -> np.ndarray:
        """Contexts of the labelled samples."""
        return np.zeros(self.n, int) if self.context is None else self.context

    @cached_property
    def clusters(self) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " N"]]:
        """Clusters of labelled and unlabelled samples, numbered from 0; those with labels come first.

        Each sample is its own where there are none.
        """
        if self.cluster is None:
            return np.arange(self.n), np.arange(self.n, self.n + self.n_unlabelled)
        names, own = np.unique(self.cluster, return_inverse=True)
        if self.cluster_unlabelled is None:
            return own, np.zeros(0, int)
        others, rest = np.unique(self.cluster_unlabelled, return_inverse=True)
        place = np.minimum(np.searchsorted(names, others), len(names) - 1)
        known = names[place] == others
        return own, np.where(known, place, len(names) - 1 + np.cumsum(~known))[rest]

    def chunks(self, *, averaged: bool = False) -> Generator[Chunk]:
        """The unlabelled samples as JAX's arrays, one chunk after another, all of one size.

        Args:
            averaged: give the average of all predictors instead of each.
        """
        name = "averaged" if averaged else "each"
        if name in self._whole:
            yield self._whole[name]
            return
        size = self.rows_per_chunk
        for read in self._read():
            chunk = _filled(_averaged(read) if averaged else read, size)
            if size >= self.n_unlabelled:
                self._whole[name] = chunk
            yield chunk

    def blocks(self) -> Generator[Chunk]:
        """The unlabelled samples as NumPy's arrays, in blocks that a processor's cache holds."""
        for chunk in self._read():
            width = max(chunk.x.shape[1], chunk.prediction[0].size)
            rows = max(_BLOCK_NUMBERS // width, 1000)
            for start in range(0, len(chunk.weight), rows):
                yield Chunk(*(part[start : start + rows] for part in chunk))

    @property
    def rows_per_chunk(self) -> int:
        """Unlabelled samples read at a time."""
        if self.chunk is not None:
            return min(self.chunk, max(self.n_unlabelled, 1))
        prediction = self.prediction_unlabelled
        shape = () if prediction is None or callable(prediction) else prediction.shape[1:]
        width = self.features.shape[1] + int(np.prod(shape)) + 2
        return min(max(_CHUNK_NUMBERS // width, 1024), max(self.n_unlabelled, 1))

    def _read(self) -> Generator[Chunk]:
        """The unlabelled samples as they are given, a bounded amount at a time."""
        rows, count = self.rows_per_chunk, self.n_unlabelled
        ones, zeros = np.ones(min(rows, count)), np.zeros(min(rows, count), int)
        for start in range(0, count, rows):
            here = slice(start, min(start + rows, count))
            size = here.stop - start
            x = np.zeros((size, 0)) if self.x_unlabelled is None else np.asarray(self.x_unlabelled[here])
            given = self.prediction_unlabelled
            told = np.asarray(given(x) if callable(given) else given[here])
            prediction = real("prediction_unlabelled", told)
            weight, context = self.weight_unlabelled, self.context_unlabelled
            yield Chunk(
                real("x_unlabelled", x),
                prediction.reshape(prediction_shape(prediction.shape, size, self.y.shape[1:])),
                ones[:size] if weight is None else weight[here],
                zeros[:size] if context is None else context[here],
            )


def averaged(prediction: Float[Values, "sample fold ..."]) -> Float[Values, "sample 1 ..."]:
    """The mean over predictors."""
    count = prediction.shape[1]
    if count == 1:
        return prediction
    if prediction.ndim == 2:
        return (prediction @ np.full(count, 1 / count, prediction.dtype))[:, None]
    return prediction.mean(axis=1, keepdims=True)


def _averaged(chunk: Chunk) -> Chunk:
    return chunk._replace(prediction=averaged(chunk.prediction))


def _filled(chunk: Chunk, size: int) -> Chunk:
    """JAX's arrays of `size` rows; a loss need not be finite but where there are samples, so the last is repeated."""
    short = size - len(chunk.weight)

    def filled(array: Values) -> Array:
        whole = jnp.asarray(array)
        return jnp.concatenate([whole, jnp.repeat(whole[-1:], short, axis=0)]) if short else whole

    weight = jnp.pad(jnp.asarray(chunk.weight), (0, short))
    return Chunk(*(filled(part) for part in chunk))._replace(weight=weight)
