"""What effects on antennas share: which ends have arrays, the phase of an element, the gain of a changed field."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from dtprob.effects.common import SIDES, Data, Sites, array_of, has_phase, n_antenna, offers, phasor
from dtprob.effects.effect import Rewrite
from dtprob.raytracing.field import path_gain

DIRECTION: Final = {"rx": "arrival", "tx": "departure"}
"""The site that tells the direction of travel at each end."""

_SIGN: Final = {"rx": -1.0, "tx": 1.0}

type Advance = Callable[[Mapping[str, Any], Any, Any], Any]
"""(parameters, direction, element positions) -> metres along the wave, for every element of every path."""


def ends(sites: Sites) -> list[tuple[str, int]]:
    """The ends with several antennas in a model with phases, and their number of antennas."""
    if not has_phase(sites):
        return []
    return [(side, n_antenna(sites, side)) for side in SIDES if n_antenna(sites, side) > 1]


def arrays(sites: Sites, data: Data) -> dict[str, np.ndarray]:
    """Element positions at the ends with several antennas, where they and the directions are known."""
    found = {side: array_of(data, side) for side, _ in ends(sites) if offers(sites, DIRECTION[side])}
    return {
        side: array for side, array in found.items() if array is not None and data.get("paths") is not None
    }


def phase_rewrite(side: str, advance: Advance) -> Rewrite:
    """Rewrite of an array response that adds a length along the wave to the phase of every element."""

    def turn(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        paths, positions = context["paths"], jnp.asarray(context[f"{side}_array"])
        metres = advance(p, context[DIRECTION[side]], positions)
        return value * phasor(_SIGN[side] * 2 * jnp.pi / paths.wavelength * metres)

    return turn


def gain_of_field(
    side: str, field: Float[Array, "link path 3"] | Complex[Array, "link path 3"], context: Mapping[str, Any]
) -> Complex[Array, "link path"]:
    """Path gains were the elements at one end to have this field; linear in it.

    Args:
        side: "rx" or "tx".
        field: of the elements towards each path.
        context: data and sites by name.
    """
    return path_gain(
        eqx.tree_at(lambda paths: getattr(paths, f"{side}_field"), context["paths"], field),
        context["permittivity"],
        context["conductivity"],
        thickness=context.get("thickness"),
        law=context.get("law", "slab"),
    )
