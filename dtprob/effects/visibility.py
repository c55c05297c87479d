"""Paths that the twin has and reality lacks, or weakens: wrong classes of paths, and obstacles in the way."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.effects.common import (
    Data,
    Family,
    Sites,
    half_normal,
    meets,
    normal,
    offers,
    touched_objects,
)
from dtprob.effects.effect import Effect
from dtprob.effects.pole import poles
from dtprob.raytracing.paths import NONE, REFRACTION, SPECULAR, PathSet

type Choice = Callable[[PathSet], jax.Array]
"""Which paths of a path set belong to a class, (link, path) boolean."""

_SECTORS: Final = 8


def missing_path(sites: Sites, data: Data) -> list[Effect]:
    """A class of paths in the twin is weaker in reality, or not there."""
    if not offers(sites, "path_gain") or data.get("paths") is None:
        return []
    return [
        Effect(
            "missing_path",
            {"path_gain": _scaled(choose)},
            (normal("fraction", 0.7),),
            instance=name,
            physics=f"This share of the amplitude of the paths {text} is missing in reality.",
            source="a (1 - s).",
            requires=("paths",),
        )
        for name, text, choose in _distinct(data["paths"], _classes(data))
    ]


def blockage(sites: Sites, data: Data) -> list[Effect]:
    """An obstacle attenuates the line of sight, a sector of azimuth, or what passes a narrow pole."""
    if not offers(sites, "path_gain") or data.get("paths") is None:
        return []
    sectors = [
        Effect(
            "blockage",
            {"path_gain": _attenuated(choose)},
            (half_normal("loss", 1.0, "Np"),),
            instance=name,
            physics=f"An obstacle that the scene lacks attenuates the paths {text}.",
            source="a exp(-l).",
            requires=("paths",),
        )
        for name, text, choose in _distinct(data["paths"], [_LINE_OF_SIGHT, *_sectors()])
    ]
    return [*sectors, *poles(sites, data)]


def _scaled(choose: Choice) -> Any:
    def scale(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value * (1.0 - p["fraction"] * choose(context["paths"]))

    return scale


def _attenuated(choose: Choice) -> Any:
    def attenuate(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value * jnp.exp(-p["loss"] * choose(context["paths"]))

    return attenuate


def _order(paths: PathSet) -> jax.Array:
    """Number of interactions of every path; -1 where it is not told."""
    return jnp.where(paths.is_untold, -1, jnp.sum(jnp.asarray(paths.interaction) != NONE, axis=-1))


def _has(code: int) -> Choice:
    return lambda paths: jnp.any(jnp.asarray(paths.interaction) == code, axis=-1)


def _of_order(order: int) -> Choice:
    return lambda paths: _order(paths) == order


def _via(index: int) -> Choice:
    return lambda paths: jnp.any(meets(paths, index), axis=-1)


_LINE_OF_SIGHT: Final = ("line_of_sight", "in line of sight", _of_order(0))


def _classes(data: Data) -> list[tuple[str, str, Choice]]:
    """Name, text and membership of every class of paths: by interaction, by order, by object."""
    classes: list[tuple[str, str, Choice]] = [
        _LINE_OF_SIGHT,
        ("reflection", "with a reflection", _has(SPECULAR)),
        ("refraction", "through a wall", _has(REFRACTION)),
    ]
    orders = range(1, data["paths"].depth + 1)
    classes += [(f"order_{order}", f"of order {order}", _of_order(order)) for order in orders]
    classes += [(name, f"via {name}", _via(index)) for index, name in touched_objects(data)]
    return classes


def _sectors() -> list[tuple[str, str, Choice]]:
    """Sectors of azimuth seen from the receivers (where waves come from) and from the transmitters."""
    width = 2 * np.pi / _SECTORS
    sectors: list[tuple[str, str, Choice]] = []
    for end, sign, text in (("arrival", -1.0, "that arrive from"), ("departure", 1.0, "that leave towards")):
        for part in range(_SECTORS):

            def choose(
                paths: PathSet, end: str = end, sign: float = sign, centre: float = part * width
            ) -> jax.Array:
                direction = sign * getattr(paths, end)
                azimuth = jnp.arctan2(direction[..., 1], direction[..., 0])
                return jnp.cos(azimuth - centre) > np.cos(width / 2)

            degrees = round(np.degrees(part * width))
            sectors.append(
                (f"{end}_{degrees}", f"{text} azimuth {degrees} +- {180 // _SECTORS} degrees", choose)
            )
    return sectors


def _distinct(paths: PathSet, classes: list[tuple[str, str, Choice]]) -> list[tuple[str, str, Choice]]:
    """The classes that hold some of the existing paths but not all, each set of paths once."""
    mask = np.asarray(paths.mask)
    seen: set[bytes] = set()
    kept = []
    for name, text, choose in classes:
        members = np.asarray(choose(paths))[mask]
        if members.any() and not members.all() and members.tobytes() not in seen:
            seen.add(members.tobytes())
            kept.append((name, text, choose))
    return kept


FAMILIES: Final[dict[str, Family]] = {"missing_path": missing_path, "blockage": blockage}
