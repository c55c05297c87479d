"""What the predictions are worth: lambda with its interval, labels gained, and where the predictor is wrong.

The regions in which a predictor trained in simulation is biased on measured labels are the sim-to-real gap of
labels.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float
from scipy import stats

from dtprob.errors import InputError
from dtprob.models.prediction_powered.result import Estimate
from dtprob.models.prediction_powered.sample import Sample


class Range(NamedTuple):
    """A value with an interval."""

    value: float
    low: float
    high: float


@final
@dataclass(frozen=True, kw_only=True)
class Worth:
    """What the predictions brought.

    Attributes:
        lam: lambda averaged over parameters and contexts, with an interval for the closed form.
        labels_gained: how many more labels would have brought the same total variance without predictions;
            negative where predictions cost more than they bring.
        variance_ratio: total variance over that without predictions.
        warnings: sentences on what is not right; empty where all is well.
    """

    lam: Range
    labels_gained: float
    variance_ratio: float
    warnings: tuple[str, ...]


@final
@dataclass(frozen=True, kw_only=True)
class Region:
    """A box of features with the predictor's bias in it.

    Attributes:
        low, high: edges of the box per feature, infinite where it is open.
        count: labelled samples inside.
        bias: mean label minus prediction, with an interval.
        p_value: of no bias there, corrected for the number of regions (Holm).
    """

    low: Float[np.ndarray, " feature"]
    high: Float[np.ndarray, " feature"]
    count: int
    bias: Range
    p_value: float


@final
@dataclass(frozen=True, kw_only=True)
class BiasMap:
    """Where a predictor is wrong.

    Attributes:
        regions: boxes that cover all labelled samples, the least likely to be unbiased first.
        scale: slope of the labels in the predictions, 1 for a predictor that is neither timid nor bold.
        scale_p_value: of a slope of 1.
        shift_p_value: of labelled and unlabelled features having one distribution, per feature
            (Kolmogorov-Smirnov), the smallest corrected for their number; 1 without unlabelled features.
        shifted_feature: the feature with that smallest one.
    """

    regions: tuple[Region, ...]
    scale: Range
    scale_p_value: float
    shift_p_value: float
    shifted_feature: int

    def biased(self, level: float = 0.05) -> tuple[Region, ...]:
        """The regions whose bias is hardly chance."""
        return tuple(region for region in self.regions if region.p_value < level)


def worth(estimate: Estimate) -> Worth:
    """What the predictions brought to an estimate."""
    variance = float(np.sum(np.diagonal(estimate.covariance)))
    alone = float(np.sum(estimate.labels_only_variance))
    ratio = variance / alone if alone > 0 else 1.0
    value, raw = float(np.mean(estimate.lam.value)), float(np.mean(estimate.lam.raw))
    half = stats.norm.ppf((1 + estimate.level) / 2) * float(np.mean(estimate.lam.standard_error))
    lam = Range(value, float(np.clip(raw - half, 0, 1)), float(np.clip(raw + half, 0, 1)))
    gained = estimate.n * (1 / ratio - 1) if ratio > 0 else np.inf
    return Worth(
        lam=lam,
        labels_gained=float(gained),
        variance_ratio=ratio,
        warnings=(*estimate.notes, *_warnings(estimate, lam, float(gained))),
    )


def _warnings(estimate: Estimate, lam: Range, gained: float) -> list[str]:
    found: list[str] = []
    if estimate.scheme.name == "erm" or not estimate.n_unlabelled:
        return found
    if estimate.scheme.is_tuned and lam.low <= 0.0:
        found.append(
            f"Nothing certain is gained from the predictions: lambda is {lam.value:.2f}, "
            f"its interval {lam.low:.2f} to {lam.high:.2f}. Use a better predictor, or ERM."
        )
    elif gained < 0.05 * estimate.n:
        found.append(
            f"The predictions are worth {gained:.0f} labels beside {estimate.n}. "
            "Use a better predictor, or a tuned scheme."
        )
    if estimate.scheme.is_tuned and float(np.mean(estimate.lam.raw)) < -2 * float(
        np.mean(estimate.lam.standard_error)
    ):
        found.append("The predictions go against the labels. Check the sign and the order of the predictor.")
    return found


def bias_map(
    sample: Sample,
    x: Float[np.ndarray, "sample feature"] | None = None,
    *,
    per_region: int = 20,
    level: float = 0.9,
) -> BiasMap:
    """Where in x a predictor is biased, whether it is timid or bold, and whether x is drawn alike.

    The boxes come from halving the labelled samples at medians of the feature that spreads most (a k-d tree),
    which does not look at labels, so that the tests are exact up to the t approximation.

    Args:
        sample: labelled samples with predictions.
        x: features to look in, instead of the sample's own.
        per_region: labelled samples that a box must have.
        level: of the intervals.

    Raises:
        InputError: no predictions, labels of several entries, or no features.
    """
    places = sample.features if x is None else np.asarray(x, float)
    if sample.prediction is None or sample.y.ndim != 1 or places.shape[1] == 0:
        remedy = "Give a prediction per label, one number each, and features"
        got = "predictions missing" if sample.prediction is None else f"labels of shape {sample.y.shape}"
        raise InputError("bias map", "scalar labels with predictions and features", got, remedy)
    residual = sample.y - sample.prediction
    boxes = _boxes(places, per_region)
    found = [_region(residual[members], box, level) for members, box in boxes]
    order = np.argsort([region.p_value for region in found])
    corrected = np.maximum.accumulate(
        [found[i].p_value * (len(found) - rank) for rank, i in enumerate(order)]
    )
    scale, scale_p = _slope(sample.prediction, sample.y, level)
    count = 20 * len(places) if x is None else 0
    other = _drawn(sample.x_unlabelled, count, sample.rows_per_chunk)
    shift, feature = (1.0, 0) if other is None else feature_shift(places, other)
    return BiasMap(
        regions=tuple(
            _with_p_value(found[i], min(1.0, float(p))) for i, p in zip(order, corrected, strict=True)
        ),
        scale=scale,
        scale_p_value=scale_p,
        shift_p_value=shift,
        shifted_feature=feature,
    )


type _Box = tuple[np.ndarray, np.ndarray]


def _boxes(places: np.ndarray, per_region: int) -> list[tuple[np.ndarray, _Box]]:
    """Members and edges of the leaves of a k-d tree with at least `per_region` samples each."""
    spread = np.std(places, axis=0)
    scaled = places / np.where(spread > 0, spread, 1.0)
    infinite = np.full(places.shape[1], np.inf)
    waiting: list[tuple[np.ndarray, _Box]] = [(np.arange(len(places)), (-infinite, infinite))]
    leaves: list[tuple[np.ndarray, _Box]] = []
    while waiting:
        members, box = waiting.pop()
        halves = _halved(places[members], np.ptp(scaled[members], axis=0), per_region)
        if halves is None:
            leaves.append((members, box))
            continue
        feature, middle, left = halves
        for side, inside in ((1, left), (0, ~left)):
            edges = box[0].copy(), box[1].copy()
            edges[side][feature] = middle
            waiting.append((members[inside], edges))
    return leaves


def _halved(places: np.ndarray, extent: np.ndarray, per_region: int) -> tuple[int, float, np.ndarray] | None:
    """The widest feature at whose median samples part into two large enough sides, the median, and who is below it.

    Many may stand at the median itself, as of a feature of two values; none where no feature parts them.
    """
    for feature in np.argsort(-extent, kind="stable"):
        middle = float(np.median(places[:, feature]))
        left = places[:, feature] < middle
        if min(left.sum(), (~left).sum()) >= per_region:
            return int(feature), middle, left
    return None


def _region(values: np.ndarray, box: _Box, level: float) -> Region:
    mean = float(np.mean(values))
    if len(values) < 2:
        bias = Range(mean, -math.inf, math.inf)
        return Region(low=box[0], high=box[1], count=len(values), bias=bias, p_value=1.0)
    error = float(np.std(values, ddof=1) / np.sqrt(len(values)))
    degrees = len(values) - 1
    half = float(stats.t.ppf((1 + level) / 2, degrees)) * error
    p_value = float(2 * stats.t.sf(abs(mean) / error, degrees)) if error > 0 else float(mean == 0)
    return Region(
        low=box[0],
        high=box[1],
        count=len(values),
        bias=Range(mean, mean - half, mean + half),
        p_value=p_value,
    )


def _with_p_value(region: Region, p_value: float) -> Region:
    return Region(low=region.low, high=region.high, count=region.count, bias=region.bias, p_value=p_value)


def _slope(prediction: np.ndarray, y: np.ndarray, level: float) -> tuple[Range, float]:
    """Slope of the labels in the predictions, and the p-value of 1; nothing is known from fewer than three labels."""
    degrees = len(y) - 2
    if np.ptp(prediction) == 0 or degrees < 1:
        return Range(1.0, -np.inf, np.inf), 1.0
    fit: Any = stats.linregress(prediction, y)
    slope, error = float(fit.slope), float(fit.stderr)
    half = float(stats.t.ppf((1 + level) / 2, degrees)) * error
    p_value = float(2 * stats.t.sf(abs(slope - 1) / error, degrees)) if error > 0 else float(slope == 1)
    return Range(slope, slope - half, slope + half), p_value


def _drawn(array: Any, count: int, rows: int) -> np.ndarray | None:
    """At most `count` rows from all over an array, whose order may mean something; read `rows` at a time."""
    if array is None or min(count, len(array)) == 0:
        return None
    size = len(array)
    chosen = np.zeros(size, bool)
    chosen[np.random.default_rng(0).choice(size, min(count, size), replace=False)] = True
    starts = range(0, size, rows)
    return np.concatenate([np.asarray(array[i : i + rows])[chosen[i : i + rows]] for i in starts])


def feature_shift(
    places: Float[np.ndarray, "sample feature"], other: Float[np.ndarray, "other feature"]
) -> tuple[float, int]:
    """P-value of two groups having one distribution of each feature, and the feature that speaks most against it.

    Kolmogorov-Smirnov, corrected for the number of features (Bonferroni).
    """
    tests: list[float] = []
    for own, others in zip(places.T, other.T, strict=True):
        result: Any = stats.ks_2samp(own, others)
        tests.append(float(result.pvalue))
    feature = int(np.argmin(tests))
    return min(1.0, float(tests[feature]) * len(tests)), feature
