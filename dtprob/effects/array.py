"""Antenna arrays: elements that differ, couple, stand elsewhere or are turned.

A receiving element at r answers a wave travelling along k with exp(-j 2 pi / lambda r.k), a transmitting one
with the opposite sign. "rx" and "tx" in an instance's name say which end is meant; "rx_3" is one element.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dtprob.effects.common import (
    COMPLEX,
    Data,
    Family,
    Sites,
    array_of,
    band,
    chain,
    complex_of,
    each_antenna,
    half_normal,
    normal,
    offers,
    on_axis,
    phasor,
    positions,
    told,
)
from dtprob.effects.effect import FIELD, Effect
from dtprob.effects.elements import DIRECTION, arrays, ends, phase_rewrite
from dtprob.effects.meaning import CHANNEL_AXES
from dtprob.effects.unfolding import to_transmitter
from dtprob.raytracing.beyond import with_all
from dtprob.raytracing.field import frequency_response
from dtprob.raytracing.paths import PathSet

_NEIGHBOUR: Final = 1.5
"""Elements count as neighbours up to this multiple of the smallest distance, so those across a square do."""
_OF_A_PATH: Final = (
    "path_gain",
    "path_delay",
    "path_phase",
    "rx_response",
    "tx_response",
    "frequency_response",
)
"""Sites from which the sum over paths is made anew."""


def array_calibration(sites: Sites, _data: Data) -> list[Effect]:
    """Complex gains of the chains behind the elements: all against the first, or one element alone."""
    effects = []
    for side, count in ends(sites):

        def weigh_all(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
            first = jnp.zeros(1)
            return value * _gain(
                jnp.concatenate([first, p["log_gain"]]), jnp.concatenate([first, p["phase"]])
            )

        others = tuple(map(str, range(1, count)))
        whole = Effect(
            "array_calibration",
            {f"{side}_response": weigh_all},
            (
                normal("log_gain", 0.2, "Np", count - 1, others),
                normal("phase", 0.5, "rad", count - 1, others),
            ),
            instance=side,
            physics=f"Unknown complex gains of the {side} elements, the first one being the reference.",
            source="diag(exp(g + j phi)) on the array response.",
        )
        effects.append(whole)
        for index, name in each_antenna(count, side):

            def weigh(value: Any, p: Mapping[str, Any], _: Mapping[str, Any], index: int = index) -> Any:
                own = jnp.arange(value.shape[-1]) == index
                return jnp.where(own, value * (1 - p["fraction"]) * phasor(p["phase"]), value)

            effects.append(
                Effect(
                    "array_calibration",
                    {f"{side}_response": weigh},
                    (
                        told(normal("fraction", 0.7), "amplitude that it lacks", "percent"),
                        normal("phase", 0.5, "rad"),
                    ),
                    instance=name,
                    physics=f"Element {index} of the {side} array lacks this share of its amplitude (1: it is dead).",
                    source="(1 - s) exp(j phi) on one element's response.",
                )
            )
    return effects


def cable_delay(sites: Sites, data: Data) -> list[Effect]:
    """The cable of one element is longer; the carrier's phase counts as calibrated."""
    measured = band(data)
    if measured is None:
        return []
    effects = []
    for side, count in ends(sites):
        for index, name in each_antenna(count, side) or [(1, f"{side}_1")]:
            axis = f"{side}_antenna"

            def delay(
                value: Any,
                p: Mapping[str, Any],
                context: Mapping[str, Any],
                index: int = index,
                axis: str = axis,
            ) -> Any:
                place = CHANNEL_AXES.index(axis)
                own = on_axis(jnp.arange(value.shape[place]) == index, axis, CHANNEL_AXES)
                turn = phasor(-2 * jnp.pi * jnp.asarray(context["subcarrier_frequency"]) * p["delay"])
                return jnp.where(own, value * turn, value)

            effects.append(
                Effect(
                    "cable_delay",
                    {"noiseless_channel": delay},
                    (normal("delay", 0.25 / measured.width, "s"),),
                    instance=name,
                    physics=f"Baseband delay of {side} element {index} alone.",
                    source="exp(-j 2 pi f_k d) on one element.",
                    requires=("subcarrier_frequency",),
                )
            )
    return effects


def mutual_coupling(sites: Sites, data: Data) -> list[Effect]:
    """Every element picks up a share of what its neighbours see, one share for each way to a neighbour."""
    effects = []
    for side, _ in ends(sites):
        array = array_of(data, side)
        if array is None:
            continue
        neighbours = _neighbours(array)
        kinds = [f"{kind}_" for kind in range(len(neighbours))] if len(neighbours) > 1 else [""]
        labels = tuple(f"{kind}{part}" for kind in kinds for part in COMPLEX)

        def couple(value: Any, p: Mapping[str, Any], _: Mapping[str, Any], masks: Any = neighbours) -> Any:
            shares = complex_of(p["coupling"].reshape(-1, 2))
            return value + jnp.einsum("...a,c,cba->...b", value, shares, jnp.asarray(masks))

        effects.append(
            Effect(
                "mutual_coupling",
                {f"{side}_response": couple},
                (normal("coupling", 0.1, "1", 2 * len(neighbours), labels),),
                instance=side,
                physics=f"Complex coupling of neighbouring {side} elements (real, imaginary), alike for pairs that stand"
                f" alike: {len(neighbours)} kinds.",
                source="(I + sum c_d A_d) a, A_d the pairs at displacement d: first order of Gupta and Ksienski,"
                " IEEE Trans. Antennas Propag. 31 (1983).",
            )
        )
    return effects


def _neighbours(array: Float[np.ndarray, "antenna 3"]) -> Float[np.ndarray, "kind antenna antenna"]:
    """Which elements are neighbours, a mask for each displacement up to its sign; those at one place are a kind too."""
    step = array[:, None] - array[None]
    distance = np.linalg.norm(step, axis=-1)
    nearest = np.min(distance, where=distance > 0, initial=np.inf)
    nearest = nearest if np.isfinite(nearest) else 1.0
    rounded = np.round(step / nearest, 3)
    first = np.take_along_axis(rounded, np.argmax(rounded != 0, axis=-1)[..., None], axis=-1)
    rounded = rounded * np.where(first < 0, -1.0, 1.0)
    near = ~np.eye(len(array), dtype=bool) & (distance <= _NEIGHBOUR * nearest)
    kinds = np.unique(rounded[near], axis=0)
    return (np.all(rounded == kinds[:, None, None], axis=-1) & near).astype(float)


def element_spacing(sites: Sites, data: Data) -> list[Effect]:
    """The aperture is larger or smaller than recorded."""

    def stretch(p: Mapping[str, Any], k: Any, r: Any) -> Any:
        return p["scale"] * jnp.einsum("...x,ax->...a", k, r)

    return [
        Effect(
            "element_spacing",
            {f"{side}_response": phase_rewrite(side, stretch)},
            (normal("scale", 0.02),),
            instance=side,
            physics=f"All distances between {side} elements are off by one relative amount.",
            source="exp(-+j 2 pi / lambda (1 + s) r.k).",
            requires=("paths", f"{side}_array", DIRECTION[side]),
        )
        for side in arrays(sites, data)
    ]


def near_field(sites: Sites, data: Data) -> list[Effect]:
    """Wave fronts are spheres, not planes, at both ends: elements at one see the other's apart."""
    found = arrays(sites, data)
    if not found or not all(offers(sites, name) for name in _OF_A_PATH):
        return []

    def bend(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        paths = context["paths"]
        detour = _detour(paths, positions(context, "rx"), positions(context, "tx"))
        turn = phasor(-2 * jnp.pi / paths.wavelength * p["share"] * detour) - 1.0
        gain = context["path_gain"][:, None] * phasor(context["path_phase"])
        weight = jnp.einsum(
            "lsp,lpr,lpt,lprt->lsrtp", gain, context["rx_response"], context["tx_response"], turn
        )
        subcarriers = jnp.asarray(context["subcarrier_frequency"])
        response = frequency_response(paths, subcarriers, context["path_delay"])
        return value + jnp.einsum("lsrtp,lpk->lsrtk", weight, response) * chain(context)

    return [
        Effect(
            "near_field",
            {"noiseless_channel": bend},
            (normal("share", 1.0),),
            physics="Every pair of elements at its own distance; share 1 is the exact one.",
            source="|L k + r - t| - L - k.(r - t), r as the transmitter sees it in the mirrors; image method.",
            requires=("paths", "subcarrier_frequency", *_OF_A_PATH, *(f"{side}_array" for side in found)),
        )
    ]


def _detour(
    paths: PathSet, rx: Float[Array, "rx_antenna 3"], tx: Float[Array, "tx_antenna 3"]
) -> Float[Array, "link path rx_antenna tx_antenna"]:
    """Distance between elements along each path, less that of a plane wave, m; formed without cancellation."""
    shape = paths.departure.shape
    mirrored = jax.vmap(lambda r: to_transmitter(paths, jnp.broadcast_to(r, shape)), out_axes=2)(rx)
    step = mirrored[:, :, :, None] - tx
    along = jnp.einsum("lpx,lprtx->lprt", paths.departure, step)
    length = jnp.where(with_all(paths).mask, paths.length, 1.0)[..., None, None]
    square = jnp.sum(step**2, -1)
    exact = jnp.sqrt(length**2 + 2 * length * along + square)
    return (square - along**2) / (exact + length + along)


def angular_spread(sites: Sites, data: Data) -> list[Effect]:
    """Each path comes from (goes to) a direction that differs at random from the traced one."""
    effects = []
    for side in arrays(sites, data):
        if not offers(sites, DIRECTION[side]):
            continue

        def spread(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
            radial = jnp.sum(p[FIELD] * value, -1, keepdims=True)
            return value + p["scale"] * (p[FIELD] - radial * value)

        effects.append(
            Effect(
                "angular_spread",
                {DIRECTION[side]: spread},
                (half_normal("scale", 0.03, "rad"),),
                instance=side,
                kind="variance",
                physics=f"Random direction of every path at the {side} end, as rough scenes give.",
                source="k' = k + s (z - (z.k) k), to first order a rotation.",
            )
        )
    return effects


def _gain(log_gain: Float[Array, "*n"], phase: Float[Array, "*n"]) -> jax.Array:
    return jnp.exp(log_gain) * phasor(phase)


FAMILIES: Final[dict[str, Family]] = {
    "near_field": near_field,  # what makes the sum over paths anew comes before what acts on the sum
    "array_calibration": array_calibration,
    "cable_delay": cable_delay,
    "mutual_coupling": mutual_coupling,
    "element_spacing": element_spacing,
    "angular_spread": angular_spread,
}
