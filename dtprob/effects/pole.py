"""A narrow upright obstacle in front of a transmitter, a pole or a tree trunk, wherever it may stand."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.constants import speed_of_light

from dtprob.effects.common import Data, Sites, half_normal, offers, phasor, place
from dtprob.effects.effect import Effect
from dtprob.raytracing.paths import NONE, REFRACTION, PathSet

_SHARES: Final = (0.03, 0.4)
"""Nearest and farthest distance at which a pole is looked for, as shares of the middle path from the transmitter."""
_DISTANCES: Final = 44
"""Distances between, in equal ratios."""
_ZONE: Final = 0.4
"""Step between azimuths, as a share of wavelength over distance: the scores of a pole change from one to the next."""
_AZIMUTHS: Final = (512, 8192)
"""Fewest and most azimuths."""
_SAME: Final = 1e-3
"""Transmitters closer than this, in m, are one."""
_MOST: Final = 8
"""Transmitters in front of which poles are looked for."""
_ENDLESS: Final = 1e6
"""Metres that no pole is away; a finite number has derivatives."""
_UPRIGHT: Final = 0.9
"""Surfaces whose normal is more upright than this turn no wave aside."""


def poles(sites: Sites, data: Data) -> list[Effect]:
    """A pole in front of each transmitter that several links share; none where there are many such transmitters."""
    paths: PathSet | None = data.get("paths")
    if paths is None or not offers(sites, "path_gain"):
        return []
    found = list(_transmitters(paths))
    names = ["pole"] if len(found) == 1 else [f"pole_{index}" for index in range(len(found))]
    pairs = zip(found, names, strict=True)
    return [_pole(*one, paths.frequency, name) for one, name in pairs] if len(found) <= _MOST else []


def _pole(transmitter: np.ndarray, middle: float, frequency: float, instance: str) -> Effect:
    distances = np.geomspace(_SHARES[0] * middle, _SHARES[1] * middle, _DISTANCES)
    usual = float(np.sqrt(distances[0] * distances[-1]))
    count = 2 * np.pi * usual * frequency / (_ZONE * speed_of_light)
    azimuths = np.linspace(-np.pi, np.pi, int(np.clip(count, *_AZIMUTHS)), endpoint=False)

    def shade(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        paths: PathSet = context["paths"]
        away = jnp.maximum(p["distance"], 0.2 * distances[0])
        own = jnp.all(jnp.abs(jnp.asarray(paths.tx_position) - transmitter) < _SAME, axis=-1)[:, None]
        return value * (1.0 - jnp.where(own, _removed(paths, p["width"], p["azimuth"], away), 0.0))

    return Effect(
        "blockage",
        {"path_gain": shade},
        (
            half_normal("width", 0.5, "m"),
            place("azimuth", azimuths, "rad", centre=0.0, spread=np.pi / np.sqrt(3)),
            place("distance", distances, "m", centre=usual, spread=float(distances.std())),
        ),
        instance=instance,
        physics="A pole or trunk that the scene lacks, this far from the transmitter, takes away the wave that would pass"
        " through it.",
        source="Babinet's principle: what passes exp(-pi x^2 / w^2) is gone, int exp(-j k (r1(x) + r2(x) - r)) dx "
        "sqrt(j (1/r1 + 1/r2) / wavelength) (1 + cos b) / 2, b the turn; Born & Wolf, Principles of Optics, 8.3.",
        requires=("paths",),
    )


def _removed(paths: PathSet, width: Any, azimuth: Any, distance: Any) -> Complex[Array, "link path"]:
    """Share of the field of each path that an upright Gaussian screen takes away, detours to second order in its breadth.

    Args:
        paths: of all links; unfolded, so that the receiver of a reflected path stands behind the wall.
        width: integral of the screen's profile over its breadth, m.
        azimuth: of the screen as seen from the transmitter, rad.
        distance: of the screen from the transmitter, m.
    """
    departure, length = jnp.asarray(paths.departure), jnp.asarray(paths.length)
    level, wavelength = jnp.hypot(departure[..., 0], departure[..., 1]), speed_of_light / paths.frequency
    is_seen = (level > 0.1) & (length > 0)
    total, height = jnp.where(is_seen, level * length, 1.0), departure[..., 2] * length
    east, north = (jnp.where(is_seen, departure[..., i] * length, side) for i, side in enumerate((1.0, 0.0)))
    ahead = east * jnp.cos(azimuth) + north * jnp.sin(azimuth) - distance  # from the screen to the receiver
    beside = north * jnp.cos(azimuth) - east * jnp.sin(azimuth)
    after = jnp.maximum(jnp.sqrt(ahead**2 + beside**2 + 1e-12), 0.1 * distance)
    way = jnp.hypot(distance + after, height)
    slope = (distance + after) / way  # the way past the screen rises, too
    detour = (distance + after - total) * (distance + after + total) / (way + jnp.hypot(total, height))
    sine, cosine = beside / after, ahead / after
    gradient, curvature = -slope * sine, slope * (1 / distance + cosine**2 / after)
    # 1 / (1 + j bend) in polar form: real functions are several times faster
    bend = curvature * width**2 / wavelength
    aside = np.pi * (gradient * width / wavelength) ** 2 / (1 + bend**2)
    strength = jnp.sqrt(slope * (1 / distance + 1 / after) / wavelength)
    strength = strength * total / (distance + after) * (1 + cosine) / 2
    strength = strength * jax.lax.rsqrt(jnp.sqrt(1 + bend**2))
    size = width * strength * jnp.exp(-aside)
    phase = aside * bend + np.pi / 4 - jnp.arctan(bend) / 2 - 2 * np.pi * detour / wavelength
    field = size * phasor(phase)
    free = jax.nn.sigmoid((_first_leg(paths) - distance) / (0.1 * distance))
    return jnp.where(is_seen, free * field, 0.0)


def _first_leg(paths: PathSet) -> Float[Array, "link path"]:
    """Level distance from the transmitter to where a wall first turns the path aside; endless where none does."""
    turns = (jnp.asarray(paths.interaction) != NONE) & (jnp.asarray(paths.interaction) != REFRACTION)
    turns &= jnp.abs(jnp.asarray(paths.normal)[..., 2]) < _UPRIGHT
    vertex = jnp.asarray(paths.vertex)[..., :2]
    start = jnp.broadcast_to(jnp.asarray(paths.tx_position)[:, None, None, :2], vertex[..., :1, :].shape)
    legs = jnp.diff(vertex, axis=-2, prepend=start)
    reached = jnp.cumsum(jnp.hypot(legs[..., 0], legs[..., 1]), axis=-1)
    return jnp.min(jnp.where(turns, reached, _ENDLESS), axis=-1, initial=_ENDLESS)


def _transmitters(paths: PathSet) -> Iterator[tuple[np.ndarray, float]]:
    """Places of transmitters that two links or more share, and the middle length of their paths."""
    mask, positions, lengths = (np.asarray(v) for v in (paths.mask, paths.tx_position, paths.length))
    left = np.ones(len(positions), bool)
    while left.any():
        transmitter = positions[int(left.argmax())]
        own = np.all(np.abs(positions - transmitter) < _SAME, axis=-1)
        left &= ~own
        if own.sum() > 1 and mask[own].any():
            yield transmitter, float(np.median(lengths[own][mask[own]]))
