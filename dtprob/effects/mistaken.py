"""What a campaign's notes may have wrong: whose place is whose, the carrier, the bandwidth."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.effects.common import Data, Family, Sites, band, normal, of_model, offers
from dtprob.effects.effect import Effect
from dtprob.raytracing.beyond import only
from dtprob.raytracing.paths import PathSet

_SAME_PLACE: Final = 1e-3
"""Positions closer than this, in m, are one place."""


def place_name(number: int) -> str:
    """Name of the paths from a transmitter's place, counted over the distinct places in ascending order of x, y, z."""
    return f"transmitter_{number}"


def swapped_transmitters(sites: Sites, data: Data) -> list[Effect]:
    """Two transmitters' places are taken for one another."""
    paths: PathSet | None = data.get("paths")
    if paths is None or not offers(sites, "path_share"):
        return []
    places = np.unique(np.asarray(paths.tx_position), axis=0)
    pairs = combinations(range(len(places)), 2)
    known = set(paths.beyond_names)
    return [
        Effect(
            "swapped_transmitters",
            {"path_share": _swapped(places, first, second)},
            (normal("share", 0.7),),
            instance=f"{first}_{second}",
            physics=f"Links of the transmitters at {_text(places[first])} and at {_text(places[second])} are really those"
            " of the other: this share of the amplitude of the other's paths, the rest of the own.",
            source="(1 - s) a_own + s a_other.",
            requires=("paths",),
        )
        for first, second in pairs
        if {place_name(first), place_name(second)} <= known
    ]


def _swapped(places: np.ndarray, first: int, second: int) -> Any:
    def swap(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        for own, other in ((first, second), (second, first)):
            here = _at(context["paths"], places[own])[:, None]
            value = value + p["share"] * here * (only(context["paths"], place_name(other)) - value)
        return value

    return swap


def _at(paths: PathSet, place: np.ndarray) -> jax.Array:
    """Which links have their transmitter at a place."""
    return jnp.max(jnp.abs(paths.tx_position - jnp.asarray(place)), axis=-1) < _SAME_PLACE


def carrier_mismatch(sites: Sites, data: Data) -> list[Effect]:
    """The carrier is another than the twin assumes."""
    if not offers(sites, "path_delay", "path_gain") or data.get("paths") is None:
        return []
    carrier = float(data["paths"].frequency)

    def turn(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value - 2 * jnp.pi * p["offset"] * context["paths"].delay[:, None, :]

    def weaken(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
        return value / (1.0 + p["offset"] / carrier)

    return [
        Effect(
            "carrier_mismatch",
            of_model(sites, {"path_gain": weaken, "path_phase": turn}),
            (normal("offset", 0.1 * carrier, "Hz"),),
            physics="The carrier lies this far above the assumed one: paths turn by it and spread with it; what"
            " it does to materials and arrays is neglected.",
            source="exp(-j 2 pi f tau); free-space loss c / (4 pi f L).",
            requires=("paths",),
        )
    ]


def bandwidth_mismatch(sites: Sites, data: Data) -> list[Effect]:
    """The subcarriers are wider or closer spaced than recorded, and the taps in inverse proportion."""
    if not offers(sites, "path_delay"):
        return []
    if band(data) is None or data.get("paths") is None:
        return []
    own_origin = offers(sites, "receiver_delay")

    def origin(delay: Any, context: Mapping[str, Any]) -> Any:
        return _first(delay, context["paths"]) if own_origin else 0.0

    def stretch(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value + p["scale"] * (value - origin(value, context))

    def hold(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        after = context["path_delay"]
        longer = p["scale"] / (1.0 + p["scale"]) * (after - origin(after, context))
        return value + 2 * jnp.pi * context["paths"].frequency * longer[:, None, :]

    return [
        Effect(
            "bandwidth_mismatch",
            of_model(sites, {"path_delay": stretch, "path_phase": hold}),
            (normal("scale", 0.1),),
            physics="All subcarriers lie this share farther from the carrier than recorded; the carrier stays. Where each"
            " link has a time origin of its own, its first path stays too.",
            source="f_k' tau = f_k (1 + s) tau; the phase that the stretched delay gives the carrier is taken off.",
            requires=("paths", "path_delay"),
        )
    ]


def _first(delay: jax.Array, paths: PathSet) -> jax.Array:
    """Delay of each link's first path, (link, 1); 0 where there is none."""
    first = jnp.min(jnp.where(paths.mask, delay, jnp.inf), axis=1, keepdims=True)
    return jnp.where(jnp.isfinite(first), first, 0.0)


def _text(place: np.ndarray) -> str:
    return "(" + " ".join(f"{x:.1f}" for x in place) + ") m"


FAMILIES: Final[dict[str, Family]] = {
    "swapped_transmitters": swapped_transmitters,
    "carrier_mismatch": carrier_mismatch,
    "bandwidth_mismatch": bandwidth_mismatch,
}
