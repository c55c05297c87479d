"""Antennas that are turned: their elements stand elsewhere and look elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dtprob.effects.common import Data, Family, Sites, along, axis_labels, normal, observable_basis, offers
from dtprob.effects.effect import Effect, Rewrite
from dtprob.effects.elements import DIRECTION, arrays, gain_of_field, phase_rewrite
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.pattern import PATTERNS, field_vector

_SAME: Final = 1e-6


def antenna_orientation(sites: Sites, data: Data) -> list[Effect]:
    """The array is turned with its elements, whose pattern and polarisation turn along where they are known."""
    effects = []
    for side, array in arrays(sites, data).items():
        basis = observable_basis(np.cross(array[:, None], np.eye(3)[None]).reshape(-1, 3))
        if not len(basis):
            continue
        rewrites: dict[str, Rewrite] = {f"{side}_response": _elsewhere(side, basis)}
        element = _element(data["paths"], side)
        if element is not None and offers(sites, "path_gain", "permittivity", "conductivity"):
            rewrites["path_gain"] = _looks_elsewhere(side, basis, *element)
        effects.append(
            Effect(
                "antenna_orientation",
                rewrites,
                (normal("rotation", 0.05, "rad", len(basis), axis_labels(basis)),),
                instance=side,
                physics=f"The {side} array is turned about its centre, around {along(basis)}.",
                source="r' = R r and F'(k) = R F(R^T k), R by Rodrigues from 2 tan(angle / 2) times the axis.",
                requires=("paths", f"{side}_array", DIRECTION[side]),
            )
        )
    return effects


def _elsewhere(side: str, basis: np.ndarray) -> Rewrite:
    """The phase of every element at its new place."""
    return phase_rewrite(
        side,
        lambda p, k, r: jnp.einsum("...x,ax->...a", k, turned(r, p["rotation"] @ jnp.asarray(basis))),
    )


def _looks_elsewhere(side: str, basis: np.ndarray, pattern: str, slant: str | float) -> Rewrite:
    """Adds the gain that the change of the elements' field gives; the gain is linear in it."""

    def turn(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        paths: PathSet = context["paths"]
        rotation = p["rotation"] @ jnp.asarray(basis)
        direction = _outwards(paths, side)
        there = field_vector(direction + turned(direction, -rotation), pattern=pattern, polarization=slant)
        here = field_vector(direction, pattern=pattern, polarization=slant)
        change = there - here + turned(there, rotation)
        return value + gain_of_field(side, change, context)

    return turn


def _element(paths: PathSet, side: str) -> tuple[str, str | float] | None:
    """Pattern and polarisation that the path set tells, if they do give the field that it holds."""
    told = dict(paths.provenance)
    pattern, text = told.get(f"{side}_pattern"), told.get(f"{side}_polarization", "V")
    if pattern not in PATTERNS:
        return None
    slant = text if text in {"V", "H"} else float(text)
    mask = np.asarray(paths.mask)
    field = field_vector(_outwards(paths, side), pattern=pattern, polarization=slant)
    held = np.asarray(getattr(paths, f"{side}_field"))
    return (pattern, slant) if np.allclose(np.asarray(field)[mask], held[mask], atol=_SAME) else None


def _outwards(paths: PathSet, side: str) -> Float[Array, "link path 3"]:
    """Direction of each path as seen from an antenna."""
    return -jnp.asarray(paths.arrival) if side == "rx" else jnp.asarray(paths.departure)


@jax.jit
def turned(vectors: Float[Array, "*n 3"], rotation: Float[Array, " 3"]) -> Float[Array, "*n 3"]:
    """R v - v for the rotation whose Rodrigues vector is rotation / 2; exactly 0 for no rotation."""
    half = jnp.broadcast_to(rotation / 2, vectors.shape)
    first = jnp.cross(half, vectors)
    return 2 * (first + jnp.cross(half, first)) / (1.0 + jnp.sum(half**2, -1, keepdims=True))


FAMILIES: Final[dict[str, Family]] = {"antenna_orientation": antenna_orientation}
