"""Where and how a predictor errs: by regions of its features, by a factor, by an old map, by noisier labels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Float

from dtprob.effects.common import Data, Family, Sites, half_normal, normal, offers
from dtprob.effects.effect import FIELD, Effect, Parameter

_FEATURES: Final = 16
"""Features, the first ones, whose regions are looked at."""
_POINTS: Final = 64
"""Points at which the errors of an old map are drawn."""
_JITTER: Final = 1e-6
_REACH: Final = 1.0
"""Distance, in standard deviations of the features, at which the errors of an old map have forgotten one another."""
_EDGE: Final = 0.05
"""Standard deviation of where a region's edge lies, as a share of the samples."""
_SOFT: Final = 1.0
"""Samples, or different values, over which a region's edge is soft, so that its place has a derivative."""
_SMOOTH: Final = 64
"""Samples that one value of a feature is shared by at most once in so many, where a region's edge may move."""

type Weight = Callable[[Any, Mapping[str, Any]], Float[Array, " sample"]]


@dataclass(frozen=True)
class _Region:
    """A region of the features: its instance, what the page says of it, its weight at features, and its own parameters."""

    name: str
    text: str
    weight: Weight
    parameters: tuple[Parameter, ...] = ()


def regional_bias(sites: Sites, data: Data) -> list[Effect]:
    """The predictor is off by a constant everywhere, in a region of a feature, or ever more along a feature."""
    if not offers(sites, "predicted_label"):
        return []
    unit = _unit(data)
    everywhere = _Region("everywhere", "everywhere", lambda x, _: jnp.ones(x.shape[0]))
    return [
        Effect(
            "regional_bias",
            {"predicted_label": _added(region.weight)},
            (normal("bias", unit), *region.parameters),
            instance=region.name,
            physics=f"Labels are higher than predicted {region.text}, by a constant.",
            source="y + b w(x), w of largest value 1.",
            requires=("x",),
        )
        for region in [everywhere, *_regions(data), *_slopes(data)]
    ]


def scale_bias(sites: Sites, data: Data) -> list[Effect]:
    """The predictor exaggerates or shrinks what it predicts, and is right at a level that nobody knows."""
    if not offers(sites, "predicted_label"):
        return []
    typical = 0.3

    def stretch(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
        return value + (value - jnp.mean(value)) * jnp.expm1(p["log_scale"]) + p["offset"]

    return [
        Effect(
            "scale_bias",
            {"predicted_label": stretch},
            (normal("log_scale", typical), normal("offset", typical * _unit(data))),
            physics="Labels differ by a common factor more than predicted from a level at which the prediction is right.",
            source="m + (y - m) exp(a) + b, m the mean prediction: a line in place of the diagonal.",
        )
    ]


def label_noise(sites: Sites, data: Data) -> list[Effect]:
    """Labels are noisier in a region of a feature than elsewhere."""
    if not offers(sites, "label_deviation"):
        return []

    def louder(weight: Weight) -> Any:
        def widen(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
            return value * jnp.exp(p["log_ratio"] * weight(context["x"], p))

        return widen

    return [
        Effect(
            "label_noise",
            {"label_deviation": louder(region.weight)},
            (normal("log_ratio", 0.7), *region.parameters),
            instance=region.name,
            physics=f"The error's standard deviation is another {region.text}.",
            source="s exp(c w(x)).",
            requires=("x",),
        )
        for region in _regions(data)
    ]


def stale_map(sites: Sites, data: Data) -> list[Effect]:
    """The map behind the predictor is old: whole districts of it are off, each by an amount of its own."""
    if not offers(sites, "predicted_label"):
        return []
    field = _districts(np.asarray(data["x"], float)[:, :2])
    if field is None:
        return []

    def shift(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value + p["scale"] * field(context["x"]) @ p[FIELD].reshape(-1)

    return [
        Effect(
            "stale_map",
            {"predicted_label": shift},
            (half_normal("scale", _unit(data)),),
            kind="variance",
            physics="Errors that neighbours in the first two features share and distant places do not, with sudden steps.",
            source="y + s f(x), f Gaussian of correlation exp(-r), r the distance in standard deviations of the features; "
            f"drawn at {_POINTS} points at most and kriged between (Rasmussen & Williams 2006, 4.2 and 8.3).",
            requires=("x",),
            field_shape=lambda *_: (1, min(_POINTS, len(data["x"]))),
        )
    ]


def _districts(
    x: Float[np.ndarray, "sample feature"],
) -> Callable[[Any], Float[Array, "sample point"]] | None:
    """What independent normal draws at points have to be multiplied by, at features, for an exponential correlation."""
    spread = x.std(axis=0)
    kept = np.flatnonzero(spread > 0)
    if not len(kept):
        return None
    unit = spread[kept] * _REACH
    points = _spread_out(x[:, kept] / unit)
    between = np.linalg.norm(points[:, None] - points[None], axis=-1)
    root = np.linalg.cholesky(np.exp(-between) + _JITTER * np.eye(len(points)))

    def weights(features: Any) -> Float[Array, "sample point"]:
        place = features[:, kept] / unit
        square = jnp.sum((place[:, None] - points[None]) ** 2, axis=-1)
        return jax.scipy.linalg.solve_triangular(root, jnp.exp(-jnp.sqrt(square)).T, lower=True).T

    return weights


def _spread_out(place: Float[np.ndarray, "sample feature"]) -> Float[np.ndarray, "point feature"]:
    """Points that cover the samples evenly: each next one is the sample farthest from those before."""
    chosen, distance = [0], np.linalg.norm(place - place[0], axis=1)
    while len(chosen) < min(_POINTS, len(place)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(place - place[chosen[-1]], axis=1))
    return place[chosen]


def _unit(data: Data) -> float:
    """Standard deviation of the predictions: what a large bias is measured by."""
    return max(float(np.std(np.asarray(data["prediction"], float))), 1e-12)


def _added(weight: Weight) -> Any:
    def add(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value + p["bias"] * weight(context["x"], p)

    return add


def _columns(data: Data) -> Iterator[tuple[int, np.ndarray]]:
    """The features that vary, by number."""
    for index, column in enumerate(np.asarray(data["x"], float).T[:_FEATURES]):
        if np.ptp(column) > 0:
            yield index, column


def _quantiles(column: np.ndarray, parts: int) -> np.ndarray:
    return np.quantile(column, np.arange(1, parts) / parts)


def _regions(data: Data) -> list[_Region]:
    """The lowest, middle and highest third of each feature; of one with two values each of them.

    Whoever drew a region did not know the samples' thirds: where a feature takes many values the edges are parameters.
    """
    regions: list[_Region] = []
    for index, column in _columns(data):
        low, high = (float(edge) for edge in _quantiles(column, 3))
        places: dict[str, tuple[float, float]] = {
            "low": (-np.inf, low),
            "middle": (low, high),
            "high": (high, np.inf),
        }
        is_smooth = np.unique(column, return_counts=True)[1].max() <= len(column) / _SMOOTH
        for name, (first, last) in places.items():
            inside = (column > first) & (column <= last)
            if not inside.any() or inside.all():
                continue
            ends = f"({column[inside].min():.3g} to {column[inside].max():.3g})"
            if is_smooth:
                weight, parameters = _soft(
                    index, column, bool(np.isfinite(first)), bool(np.isfinite(last)), inside
                )
            else:
                weight, parameters = _hard(index, first, last), ()
            text = f"where feature {index} is {name} {ends}"
            regions.append(_Region(f"x{index}_{name}", text, weight, parameters))
    return regions


def _hard(index: int, first: float, last: float) -> Weight:
    """1 inside, 0 outside."""

    def within(x: Any, _: Mapping[str, Any]) -> Float[Array, " sample"]:
        return ((x[:, index] > first) & (x[:, index] <= last)).astype(float)

    return within


def _soft(
    index: int, column: np.ndarray, is_above: bool, is_below: bool, inside: np.ndarray
) -> tuple[Weight, tuple[Parameter, ...]]:
    """1 inside, 0 outside, with edges that move and have a derivative: parameters, as quantiles of the feature."""
    values = np.unique(column)
    quantiles = (np.arange(len(values)) + 0.5) / len(values)
    width = _SOFT / len(values)
    rank = np.searchsorted(values, column[inside])
    ends = {
        "from_quantile": (is_above, rank.min() / len(values)),
        "to_quantile": (is_below, (rank.max() + 1) / len(values)),
    }
    parameters = tuple(
        Parameter(name, dist.Normal(float(place), _EDGE), float(place), is_place=True)
        for name, (is_end, place) in ends.items()
        if is_end
    )

    def weight(x: Any, p: Mapping[str, Any]) -> Float[Array, " sample"]:
        quantile, inside = jnp.interp(x[:, index], values, quantiles), jnp.ones(x.shape[0])
        if is_above:
            inside = inside * jax.nn.sigmoid((quantile - p["from_quantile"]) / width)
        if is_below:
            inside = inside * jax.nn.sigmoid((p["to_quantile"] - quantile) / width)
        return inside

    return weight, parameters


def _slopes(data: Data) -> list[_Region]:
    """Each feature itself, from -1 at its smallest to 1 at its largest value."""
    slopes: list[_Region] = []
    for index, column in _columns(data):
        middle, half = float(column.max() + column.min()) / 2, float(np.ptp(column)) / 2

        def along(
            x: Any, _: Mapping[str, Any], index: int = index, middle: float = middle, half: float = half
        ) -> jax.Array:
            return (x[:, index] - middle) / half

        slopes.append(_Region(f"x{index}_slope", f"in proportion to feature {index}", along))
    return slopes


FAMILIES: Final[dict[str, Family]] = {
    "regional_bias": regional_bias,
    "scale_bias": scale_bias,
    "label_noise": label_noise,
    "stale_map": stale_map,
}
