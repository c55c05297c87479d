"""The gap may be the tool's: what the ray tracer was told to leave out, and the law that it takes for a wall.

Paths that a fuller trace finds ride along in the path set, masked (`dtprob.raytracing.beyond`); an effect
raises their share of the amplitude.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp

from dtprob.effects.common import Data, Family, Sites, normal, offers
from dtprob.effects.effect import Effect
from dtprob.raytracing.beyond import only
from dtprob.raytracing.field import path_gain
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.slab import Law

DEPTH: Final = "depth"
"""Name of the paths that are found with more interactions than the twin allows."""
REFRACTION: Final = "refraction"
"""Name of the paths that are found through walls where the twin lets none through."""


def depth_cut_off(sites: Sites, data: Data) -> list[Effect]:
    """Paths of more interactions than the twin traces."""
    return _switched_on(
        "depth_cut_off",
        sites,
        data,
        name=DEPTH,
        text="more interactions than the twin allows",
        source="Sionna RT, max_depth.",
    )


def refraction_off(sites: Sites, data: Data) -> list[Effect]:
    """Paths through walls, where the twin lets none through."""
    return _switched_on(
        "refraction_off",
        sites,
        data,
        name=REFRACTION,
        text="a passage through a wall",
        source="ITU-R P.2040, transmission.",
    )


def wall_law(sites: Sites, data: Data) -> list[Effect]:
    """Walls reflect and pass waves by another law: half-spaces instead of slabs, or slabs instead of half-spaces."""
    if not offers(sites, "path_gain", "permittivity", "conductivity") or data.get("paths") is None:
        return []
    other: Law = "half_space" if data.get("law", "slab") == "slab" else "slab"

    def swap(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        change = _gain(context["paths"], context, other) - _gain(context["paths"], context)
        return value + p["share"] * change

    return [
        Effect(
            "wall_law",
            {"path_gain": swap},
            (normal("share", 0.7),),
            instance=other,
            physics=f"This share of the way from the twin's law of a wall to that of a {other.replace('_', ' ')},"
            " in amplitude.",
            source="ITU-R P.2040: Fresnel coefficients, with or without all internal reflections.",
            requires=("paths", "permittivity", "conductivity"),
        )
    ]


def _switched_on(family: str, sites: Sites, data: Data, *, name: str, text: str, source: str) -> list[Effect]:
    paths: PathSet | None = data.get("paths")
    if paths is None or name not in paths.beyond_names:
        return []
    if not offers(sites, "path_share"):
        return []

    def add(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        return value + p["share"] * only(context["paths"], name)

    return [
        Effect(
            family,
            {"path_share": add},
            (normal("share", 0.7),),
            physics=f"Paths with {text} count with this share of their amplitude; 1 is what a fuller trace says.",
            source=source,
            requires=("paths",),
        )
    ]


def _gain(paths: PathSet, context: Mapping[str, Any], law: Law | None = None) -> jax.Array:
    return jnp.asarray(
        path_gain(
            paths,
            context["permittivity"],
            context["conductivity"],
            thickness=context.get("thickness"),
            law=law or context.get("law", "slab"),
        )
    )


FAMILIES: Final[dict[str, Family]] = {
    "depth_cut_off": depth_cut_off,
    "refraction_off": refraction_off,
    "wall_law": wall_law,
}
