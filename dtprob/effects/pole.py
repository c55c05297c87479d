"""A narrow upright obstacle in front of a transmitter, a pole or a tree trunk, wherever it may stand."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array, Complex
from scipy.constants import speed_of_light

from dtprob.effects.common import Data, Sites, half_normal, offers
from dtprob.effects.effect import Effect, Parameter
from dtprob.raytracing.paths import PathSet

_AZIMUTHS: Final = tuple(np.linspace(-np.pi, np.pi, 1024, endpoint=False).tolist())
"""Directions from the transmitter in which a pole is looked for, rad: one may stand anywhere."""
_SHARES: Final = np.geomspace(0.1, 0.7, 40)
"""Distances at which it is looked for, as shares of the shortest path from the transmitter."""
_SAME: Final = 1e-3
"""Transmitters closer than this, in m, are one."""
_MOST: Final = 8
"""Transmitters in front of which poles are looked for."""


def poles(sites: Sites, data: Data) -> list[Effect]:
    """A pole in front of each transmitter that several links share; none where there are many such transmitters."""
    paths: PathSet | None = data.get("paths")
    if paths is None or not offers(sites, "path_gain"):
        return []
    found = list(_transmitters(paths))
    names = ["pole"] if len(found) == 1 else [f"pole_{index}" for index in range(len(found))]
    pairs = zip(found, names, strict=True)
    return [_pole(*one, name) for one, name in pairs] if len(found) <= _MOST else []


def _pole(transmitter: np.ndarray, distances: tuple[float, ...], instance: str) -> Effect:
    middle, spread = float(np.median(distances)), float(np.std(distances))

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
            Parameter(
                "azimuth", dist.Normal(0.0, np.pi / np.sqrt(3)), 0.0, "rad", is_place=True, tried=_AZIMUTHS
            ),
            Parameter("distance", dist.Normal(middle, spread), middle, "m", is_place=True, tried=distances),
        ),
        instance=instance,
        physics="A pole or trunk that the scene lacks, this far from the transmitter, takes away the wave that would pass"
        " through it.",
        source="Babinet's principle with a Gaussian profile: 1 - sqrt(j s^2 / 2) int exp(-pi x^2 / w^2) "
        "exp(-j pi s^2 (x - b)^2 / 2) dx, s^2 = 2 (1/d1 + 1/d2) / wavelength; ITU-R P.526-15, section 4.",
        requires=("paths",),
    )


def _removed(paths: PathSet, width: Any, azimuth: Any, distance: Any) -> Complex[Array, "link path"]:
    """Share of the field of each path that an upright Gaussian screen takes away, to all orders of its width.

    Args:
        paths: of all links.
        width: integral of the screen's profile over its breadth, m.
        azimuth: of the screen as seen from the transmitter, rad.
        distance: of the screen from the transmitter, m.
    """
    departure = jnp.asarray(paths.departure)
    level = jnp.hypot(departure[..., 0], departure[..., 1])
    turn = jnp.arctan2(departure[..., 1], departure[..., 0]) - azimuth
    ahead, beside = jnp.cos(turn), jnp.sin(turn)
    total = level * jnp.asarray(paths.length)
    is_hit = (ahead > 0.2) & (total * jnp.maximum(ahead, 0.2) > 1.05 * distance) & (level > 0.1)
    ahead, total = jnp.where(is_hit, ahead, 1.0), jnp.where(is_hit, total, 2.0 * distance)
    before = distance / ahead  # on the ground, from the transmitter to the screen
    offset = distance * jnp.where(is_hit, beside, 0.0) / ahead
    wavelength = speed_of_light / paths.frequency
    curvature = 2 / wavelength * jnp.where(is_hit, level, 1.0) * (1 / before + 1 / (total - before))
    spread = 1.0 + 0.5j * curvature * width**2
    field = (
        width * jnp.sqrt(0.5j * curvature / spread) * jnp.exp(-0.5j * np.pi * curvature * offset**2 / spread)
    )
    return jnp.where(is_hit, field, 0.0)


def _transmitters(paths: PathSet) -> Iterator[tuple[np.ndarray, tuple[float, ...]]]:
    """Places of transmitters that two links or more share, and the distances of poles before them."""
    mask, positions, lengths = (np.asarray(v) for v in (paths.mask, paths.tx_position, paths.length))
    for transmitter in np.unique(positions.round(3), axis=0):
        own = np.all(np.abs(positions - transmitter) < _SAME, axis=-1)
        if own.sum() > 1 and mask[own].any():
            yield transmitter, tuple((_SHARES * lengths[own][mask[own]].min()).tolist())
