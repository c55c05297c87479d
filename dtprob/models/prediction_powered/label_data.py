"""From a file of labels to the arguments of the `prediction_powered` model, for a CASE."""

import warnings
from collections.abc import Generator, Mapping
from typing import Any, Final

import jax
import numpy as np
from jaxtyping import Float, Int

from dtprob.data import Labels
from dtprob.errors import InputError, unknown_name
from dtprob.models.prediction_powered.diagnostics import BiasMap, Region, bias_map, feature_shift, worth
from dtprob.models.prediction_powered.estimate import Estimate, check_labels, estimate
from dtprob.models.prediction_powered.generalised import Calibration, posterior_data
from dtprob.models.prediction_powered.losses import named_loss
from dtprob.models.prediction_powered.predictors import JaxPredictor, Neighbours, Ridge
from dtprob.models.prediction_powered.sample import Sample
from dtprob.models.prediction_powered.training import train
from dtprob.models.prediction_powered.tuning import By

PREDICTORS: Final[dict[str, JaxPredictor]] = {"ridge": Ridge(), "neighbours": Neighbours()}
"""What can be trained where the file has no predictions."""

_SHOWN: Final = 3
_CHANCE: Final = 0.01
"""P-value below which labelled rows are said to be drawn otherwise than the rest."""


def label_data(
    data: Labels,
    *,
    loss: str = "mean",
    scheme: str = "tuned_cppi",
    predictor: str = "ridge",
    folds: int = 5,
    by: By = "overall",
    calibration: Calibration = "matrix",
    intercept: bool = True,
    level: float = 0.9,
    seed: int = 0,
) -> dict[str, Any]:
    """The arguments of `prediction_powered`, with a warning for whatever its user should know.

    A prediction that the file has is taken to come from one predictor that saw none of the labels. Without
    one, predictors are trained as the scheme says.

    Args:
        data: checked rows.
        loss: "mean", "ols", "logistic" or "poisson".
        scheme: one of the six.
        predictor: "ridge" or "neighbours", where the file has no prediction.
        folds: of the labelled rows, where predictors are trained.
        by: one lambda "overall", one per "parameter", or one per "context", a column of the file.
        calibration: as in `posterior_data`.
        intercept: whether a regression has a constant besides the features.
        level: of the intervals that the posterior's width is calibrated for.
        seed: of folds and splits.

    Raises:
        InputError: an unknown name, no contexts to tune by, labels that the loss does not allow, fewer labels
            than folds, training labels of one class.
    """
    chosen = named_loss(loss)
    check_labels(chosen, data.y[data.labelled])
    if by == "context" and data.context is None:
        remedy = "Add a column context with whole numbers from 0, or tune overall"
        raise InputError("labels", "a context of each row, to tune by context", "none", remedy)
    if predictor not in PREDICTORS:
        raise unknown_name("predictor", predictor, PREDICTORS, "predictor")
    mine, rest = np.flatnonzero(data.labelled), np.flatnonzero(~data.labelled)
    design = np.column_stack([np.ones(len(data.x)), data.x]) if intercept else data.x
    features = None if loss == "mean" else design
    given: dict[str, Any] = {"weight": data.weight, "context": data.context, "cluster": data.cluster}
    y = data.y[mine]
    if not len(rest) or data.prediction is not None:
        given |= {"x": features, "prediction": data.prediction}
        sample = Sample(y=y, **_split(given, mine, rest))
    else:
        sample = train(
            jax.random.key(seed),
            scheme,
            PREDICTORS[predictor],
            x=data.x[mine],
            y=y,
            x_unlabelled=data.x[rest],
            folds=folds,
            **_split(given | {"features": features}, mine, rest),
            probability=loss == "logistic",
        )
    found = estimate(chosen, sample, scheme, by=by, level=level)
    for sentence in (*_worth(found), *_shifts(data), *_biases(data, sample)):
        warnings.warn(sentence, stacklevel=2)
    return posterior_data(chosen, sample, found, calibration=calibration)


def _worth(found: Estimate) -> Generator[str]:
    """What the predictions brought, in words; nothing where there are none."""
    told = worth(found)
    if found.scheme.name != "erm" and found.n_unlabelled and len(told.warnings) == len(found.notes):
        yield f"The predictions are worth {told.labels_gained:.0f} labels beside {found.n}, lambda {told.lam.value:.3g}."
    yield from told.warnings


def _split(
    columns: Mapping[str, np.ndarray | None], mine: Int[np.ndarray, " n"], rest: Int[np.ndarray, " N"]
) -> dict[str, Any]:
    """The columns that there are, of labelled and, where there are any, of unlabelled rows."""
    there = {name: column for name, column in columns.items() if column is not None}
    own = {name: column[mine] for name, column in there.items()}
    other = {f"{name}_unlabelled": column[rest] for name, column in there.items()}
    return own | other if len(rest) else own


def _shifts(data: Labels) -> Generator[str]:
    """Whether labelled rows are drawn as the others are, in words; weights may even out what they are not."""
    if data.labelled.all() or data.weight is not None or data.cluster is not None:
        return
    names = [f"x_{number}" for number in range(data.x.shape[1])]
    columns = data.x
    if data.prediction is not None:
        names, columns = [*names, "prediction"], np.column_stack([columns, data.prediction])
    if not names:
        return
    p_value, feature = feature_shift(columns[data.labelled], columns[~data.labelled])
    if p_value < _CHANCE:
        yield (
            f"Labelled rows are not drawn as the others are: they differ in {names[feature]}, p = {p_value:.1g}. The "
            "estimate may be biased and its interval too narrow. Label rows at random, or add a column weight."
        )


def _biases(data: Labels, sample: Sample) -> Generator[str]:
    """Where the predictor is wrong, in words; nothing of clusters, whose samples such tests would take one by one."""
    if (
        sample.prediction is None
        or sample.cluster is not None
        or data.x.shape[1] == 0
        or sample.n != data.labelled.sum()
    ):
        return
    found = bias_map(sample, data.x[data.labelled])
    for region in found.biased()[:_SHOWN]:
        size = f"{region.bias.value:+.3g} ({region.bias.low:+.3g} to {region.bias.high:+.3g})"
        yield f"Labels differ from predictions by {size} {_where(region)}, p = {region.p_value:.1g}."
    if _is_off(found):
        low, high = found.scale.low, found.scale.high
        yield f"Labels go with {found.scale.value:.3g} ({low:.3g} to {high:.3g}) times the predictions."


def _is_off(found: BiasMap) -> bool:
    return found.scale_p_value < 0.05


def _where(region: Region) -> str:
    """The box in words, by the features that bound it."""
    parts: list[str] = []
    bounds: Float[np.ndarray, "2 feature"] = np.stack([region.low, region.high])
    for number, (low, high) in enumerate(bounds.T):
        if np.isfinite(low) and np.isfinite(high):
            parts.append(f"x_{number} is from {low:.3g} to {high:.3g}")
        elif np.isfinite(low):
            parts.append(f"x_{number} is from {low:.3g} up")
        elif np.isfinite(high):
            parts.append(f"x_{number} is below {high:.3g}")
    return f"where {' and '.join(parts)}" if parts else "everywhere"
