"""Where and how a predictor errs: by regions of its features, by a factor, by an old map, by noisier labels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dtprob.effects.common import Data, Family, Sites, half_normal, normal, offers
from dtprob.effects.covering import covering
from dtprob.effects.effect import FIELD, Effect
from dtprob.effects.label_regions import Region, Weight, groupings, regions, slopes

_POINTS: Final = 64
"""Points at which the errors of an old map are drawn."""
_JITTER: Final = 1e-6
_REACH: Final = 1.0
"""Distance, in standard deviations of the features, at which the errors of an old map have forgotten one another."""


def regional_bias(sites: Sites, data: Data) -> list[Effect]:
    """The predictor is off by a constant everywhere, in a region, or by value of a feature; or ever more along one."""
    if not _offers(sites, data, "predicted_label"):
        return []
    unit = _unit(data)
    whole = np.ones(len(data["x"]), bool)
    everywhere = Region("everywhere", "everywhere", lambda x, _: jnp.ones(x.shape[0]), whole)
    return [
        Effect(
            "regional_bias",
            {"predicted_label": _added(region.weight)},
            (normal("bias", unit), *region.parameters),
            instance=region.name,
            physics=f"Labels are off {region.text}: higher than predicted by the bias, lower where it is negative.",
            source="y + b w(x), w of largest value 1.",
            requires=("x",),
        )
        for region in [everywhere, *regions(data), *slopes(data)]
    ] + [_by_value(index, values, unit) for index, values in groupings(data)]


def _by_value(index: int, values: np.ndarray, unit: float) -> Effect:
    """Each value of a feature, such as the number of a receiver, has a constant of its own."""

    def shift(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        own = p[FIELD].reshape(-1)[jnp.argmin(jnp.abs(context["x"][:, index, None] - values), axis=1)]
        return value + p["scale"] * own

    return Effect(
        "regional_bias",
        {"predicted_label": shift},
        (half_normal("scale", unit),),
        instance=f"x{index}_each_value",
        kind="variance",
        physics=f"Labels are off by a constant of its own for each value of feature {index}, such as each receiver.",
        source="y + s z_k, z standard normal for each value k of the feature.",
        requires=("x",),
        field_shape=lambda *_: (1, len(values)),
    )


def scale_bias(sites: Sites, data: Data) -> list[Effect]:
    """The predictor exaggerates or shrinks what it predicts, and is right at a level that nobody knows."""
    if not _offers(sites, data, "predicted_label"):
        return []
    typical, middle = 0.3, float(np.mean(np.asarray(data["prediction"], float)))

    def stretch(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
        return value + (value - middle) * jnp.expm1(p["log_scale"]) + p["offset"]

    return [
        Effect(
            "scale_bias",
            {"predicted_label": stretch},
            (normal("log_scale", typical), normal("offset", typical * _unit(data))),
            physics="Labels differ by a common factor more than predicted from a level at which the prediction is right.",
            source="m + (y - m) exp(a) + b, m the mean prediction in the data: a line in place of the diagonal.",
        )
    ]


def label_noise(sites: Sites, data: Data) -> list[Effect]:
    """Labels are noisier in a region of a feature than elsewhere, or ever more along a feature."""
    if not _offers(sites, data, "label_deviation"):
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
            physics=f"The error's standard deviation differs {region.text}.",
            source="s exp(c w(x)).",
            requires=("x",),
        )
        for region in [*_apart(regions(data)), *slopes(data, least=3)]
    ]


def _apart(found: Sequence[Region]) -> list[Region]:
    """The regions that are no other's complement: noise outside is another where noise inside is."""
    kept: list[Region] = []
    for region in found:
        if all((region.inside == one.inside).any() for one in kept):
            kept.append(region)
    return kept


def stale_map(sites: Sites, data: Data) -> list[Effect]:
    """The map behind the predictor is old: whole districts of it are off, each by an amount of its own."""
    if not _offers(sites, data, "predicted_label"):
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


def _offers(sites: Sites, data: Data, name: str) -> bool:
    """Whether the model computes this site, from predictions and features of the data."""
    return offers(sites, name) and data.get("x") is not None and data.get("prediction") is not None


def _districts(
    x: Float[np.ndarray, "sample feature"],
) -> Callable[[Any], Float[Array, "sample point"]] | None:
    """What independent normal draws at points have to be multiplied by, at features, for an exponential correlation."""
    spread = x.std(axis=0)
    kept = np.flatnonzero(spread > 0)
    if not len(kept):
        return None
    unit = spread[kept] * _REACH
    places = x[:, kept] / unit
    points = places[covering(places, _POINTS)]
    between = np.linalg.norm(points[:, None] - points[None], axis=-1)
    root = np.linalg.cholesky(np.exp(-between) + _JITTER * np.eye(len(points)))

    def weights(features: Any) -> Float[Array, "sample point"]:
        place = features[:, kept] / unit
        square = jnp.sum((place[:, None] - points[None]) ** 2, axis=-1)
        return jax.scipy.linalg.solve_triangular(root, jnp.exp(-jnp.sqrt(square)).T, lower=True).T

    return weights


def _unit(data: Data) -> float:
    """What a large bias is measured by: how much predictions vary, or the errors' root mean square if that is larger."""
    predicted, seen = np.asarray(data["prediction"], float), data.get("y")
    spread = float(np.std(predicted))
    error = 0.0 if seen is None else float(np.sqrt(np.mean((np.asarray(seen, float) - predicted) ** 2)))
    return max(spread, error, 1e-12)


def _added(weight: Weight) -> Any:
    def add(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value + p["bias"] * weight(context["x"], p)

    return add


# the slope first, which acts on what is predicted: a bias beside it is in the labels' own unit
FAMILIES: Final[dict[str, Family]] = {
    "scale_bias": scale_bias,
    "regional_bias": regional_bias,
    "label_noise": label_noise,
    "stale_map": stale_map,
}
