"""How strong paths are: gains, distance laws, antenna patterns, shadowing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dtprob.effects.common import (
    SIDES,
    Data,
    Family,
    Sites,
    complex_of,
    half_normal,
    has_phase,
    legendre,
    links_and_paths,
    n_snapshot,
    normal,
    offers,
)
from dtprob.effects.effect import FIELD, Effect
from dtprob.effects.elements import DIRECTION
from dtprob.raytracing.paths import PathSet

_END: Final = {"tx": "transmitter", "rx": "receiver"}
_MOST_ENDS: Final = 16
"""Transmitters, or receivers, that are looked at one by one."""


def gain_offset(sites: Sites, data: Data) -> list[Effect]:
    """All paths are stronger or weaker by one factor, or those of one of several transmitters or receivers."""
    if not offers(sites, "path_gain"):
        return []
    everywhere = Effect(
        "gain_offset",
        {"path_gain": lambda value, p, _: value * jnp.exp(p["log_gain"])},
        (normal("log_gain", 0.3, "Np"),),
        physics="Common amplitude factor: transmit power, cable loss, antenna gain.",
        source="a exp(g).",
    )
    paths: PathSet | None = data.get("paths")
    ends = [] if paths is None else [e for side in SIDES for e in _ends(side, paths)]
    return [*([everywhere] if has_phase(sites) else []), *ends]  # powers have a level of their own


def _ends(side: str, paths: PathSet) -> list[Effect]:
    """One for each place of a side that several links share, where there are several of these."""
    name, position = _END[side], np.round(np.asarray(getattr(paths, f"{side}_position"), float), 3)
    places, count = np.unique(position, axis=0, return_counts=True)
    if not 2 <= len(places) <= _MOST_ENDS or count.min() < 2:
        return []
    return [_of_end(side, f"{name}_{k}", place) for k, place in enumerate(places)]


def _of_end(side: str, instance: str, place: np.ndarray) -> Effect:
    def strengthen(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        there = jnp.asarray(getattr(context["paths"], f"{side}_position"))
        is_its = jnp.all(jnp.abs(there - place) < 1e-3, axis=-1).reshape(-1, *(1,) * (value.ndim - 1))
        return value * jnp.exp(p["log_gain"] * is_its)

    at = ", ".join(f"{x:g}" for x in place)
    return Effect(
        "gain_offset",
        {"path_gain": strengthen},
        (normal("log_gain", 0.3, "Np"),),
        instance=instance,
        physics=f"Amplitude factor of the {instance.replace('_', ' ')} at ({at}) m: its power, cable or antenna.",
        source="a exp(g).",
        requires=("paths",),
    )


def shadowing(sites: Sites, _data: Data) -> list[Effect]:
    """Every link has a random loss of its own."""
    if not offers(sites, "path_gain"):
        return []
    return [
        Effect(
            "shadowing",
            {"path_gain": lambda value, p, _: value * jnp.exp(p["scale"] * p[FIELD])},
            (half_normal("scale", 0.3, "Np"),),
            kind="variance",
            physics="Log-normal gain common to all paths of a link, independent between links.",
            source="Log-normal shadowing, e.g. 3GPP TR 38.901, sec. 7.5.",
            field_shape=lambda value, _: (value.shape[0], 1),
        )
    ]


def path_gain_error(sites: Sites, _data: Data) -> list[Effect]:
    """Every path has a random loss of its own."""
    if not offers(sites, "path_gain"):
        return []
    return [
        Effect(
            "path_gain_error",
            {"path_gain": lambda value, p, _: value * jnp.exp(p["scale"] * p[FIELD])},
            (half_normal("scale", 0.3, "Np"),),
            kind="variance",
            physics="Log-normal gain of every path, independent: clutter that the map does not have.",
            source="Per-cluster shadowing, 3GPP TR 38.901, sec. 7.5, step 6.",
        )
    ]


def atmospheric_attenuation(sites: Sites, data: Data) -> list[Effect]:
    """The medium absorbs: rain, oxygen, foliage, dust."""
    if not offers(sites, "path_gain") or data.get("paths") is None:
        return []
    return [
        Effect(
            "atmospheric_attenuation",
            {"path_gain": lambda value, p, context: value * jnp.exp(-p["rate"] * context["paths"].length)},
            (half_normal("rate", 5e-3, "Np/m"),),
            physics="Amplitude falls exponentially with the length of a path.",
            source="Specific attenuation, ITU-R P.676 and P.838: a exp(-g L).",
            requires=("paths",),
        )
    ]


def path_loss_exponent(sites: Sites, data: Data) -> list[Effect]:
    """Power falls faster or slower with distance than in free space."""
    paths: PathSet | None = data.get("paths")
    if not offers(sites, "path_gain") or paths is None:
        return []
    lengths = np.asarray(paths.length)[np.asarray(paths.mask)]
    if not lengths.size or np.ptp(lengths) == 0:
        return []
    middle = float(np.exp(np.mean(np.log(lengths))))

    def weaken(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        length = jnp.where(context["paths"].mask, context["paths"].length, middle)
        return value * (length / middle) ** (-p["excess"] / 2)

    return [
        Effect(
            "path_loss_exponent",
            {"path_gain": weaken},
            (normal("excess", 0.3),),
            physics=f"Exponent of the power law of distance minus 2, pivot at {middle:.3g} m.",
            source="Log-distance law: power ~ L^-(2 + n).",
            requires=("paths",),
        )
    ]


def antenna_pattern(sites: Sites, data: Data) -> list[Effect]:
    """The antennas' gain over direction, or over elevation alone, differs smoothly from the twin's."""
    if not offers(sites, "path_gain") or data.get("paths") is None:
        return []
    return [
        _pattern(side, f"{side}{part}", over, text)
        for side in SIDES
        for part, over, text in (
            ("", _harmonics, "x, y, z, xy, yz, zx, x^2 - y^2, 3 z^2 - 1"),
            (
                "_elevation",
                lambda k: _harmonics(k)[..., jnp.array([2, 7])],
                "z, 3 z^2 - 1, a dipole for another",
            ),
            ("_vertical_cut", _vertical_cut, "P_n(z), n = 0..6, its mean gain included"),
        )
    ]


def _pattern(side: str, instance: str, over: Callable[[jax.Array], jax.Array], text: str) -> Effect:
    """A log gain made of some functions of the direction of travel."""

    def weigh(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value * jnp.exp(over(getattr(context["paths"], DIRECTION[side])) @ p["log_gain"])

    count = over(jnp.zeros((1, 3))).shape[-1]
    return Effect(
        "antenna_pattern",
        {"path_gain": weigh},
        (normal("log_gain", 0.15, "Np", count),),
        instance=instance,
        physics=f"Log gain of all {side} antennas over the direction of travel k, in world axes: {text}.",
        source="Spherical harmonics of degree 1 and 2, or zonal ones up to degree 6, of unit mean square over the sphere.",
        requires=("paths",),
    )


def phase_error(sites: Sites, _data: Data) -> list[Effect]:
    """Every path has a random phase of its own, beyond what the geometry tells."""
    if not has_phase(sites) or not offers(sites, "path_phase") or _has_path_phases(sites):
        return []
    effects = [_phase_error(None, 1, "as positions off by fractions of a wavelength make it")]
    if n_snapshot(sites) > 1:
        effects.append(_phase_error("each_packet", n_snapshot(sites), "new in every snapshot"))
    return effects


def _phase_error(instance: str | None, count: int, reason: str) -> Effect:
    def shape(value: Any, context: Mapping[str, Any]) -> tuple[int, int, int]:
        links, paths = links_and_paths(value, context)
        return links, count, paths

    return Effect(
        "phase_error",
        {"path_phase": lambda value, p, _: value + p["scale"] * p[FIELD]},
        (half_normal("scale", 0.5, "rad"),),
        instance=instance,
        kind="variance",
        physics=f"Independent phase of every path, {reason}.",
        source="Ruah et al., arXiv 2312.12625, the von Mises error in its Gaussian limit.",
        field_shape=shape,
    )


def diffuse_reflection(sites: Sites, _data: Data) -> list[Effect]:
    """Every path has a random complex gain beside its own, as a cloud of unresolved neighbours gives."""
    if not has_phase(sites) or not offers(sites, "path_gain"):
        return []
    return [
        Effect(
            "diffuse_reflection",
            {"path_gain": lambda value, p, _: value * (1.0 + p["scale"] * complex_of(p[FIELD]))},
            (half_normal("scale", 0.2),),
            kind="variance",
            physics="Rician fading of every path about its traced gain.",
            source="a (1 + s (z + j z')).",
            field_shape=lambda value, _: (*value.shape, 2),
        )
    ]


def _has_path_phases(sites: Sites) -> bool:
    """Whether the model already has an unknown angle per path."""
    return any(s.kind == "latent" and s.is_circular and "path" in s.axes for s in sites.values())


def _harmonics(direction: Float[Array, "*n 3"]) -> jax.Array:
    """Real spherical harmonics of degree 1 and 2, of unit mean square, (*n, 8)."""
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    first, second = 3**0.5, 15**0.5
    terms = [first * x, first * y, first * z, second * x * y, second * y * z, second * z * x]
    terms += [second / 2 * (x**2 - y**2), 5**0.5 / 2 * (3 * z**2 - 1)]
    return jnp.stack(terms, axis=-1)


def _vertical_cut(direction: Float[Array, "*n 3"]) -> jax.Array:
    """Zonal harmonics of degree 0 to 6, of unit mean square, (*n, 7)."""
    orders = range(7)
    return legendre(direction[..., 2], orders) * jnp.sqrt(2.0 * jnp.array(orders) + 1.0)


FAMILIES: Final[dict[str, Family]] = {
    "gain_offset": gain_offset,
    "shadowing": shadowing,
    "path_gain_error": path_gain_error,
    "atmospheric_attenuation": atmospheric_attenuation,
    "path_loss_exponent": path_loss_exponent,
    "antenna_pattern": antenna_pattern,
    "phase_error": phase_error,
    "diffuse_reflection": diffuse_reflection,
}
