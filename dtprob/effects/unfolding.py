"""How the paths of a twin change when something moves: exact for planar mirrors, without tracing again.

A path of specular reflections is the straight line from the transmitter's last image to the receiver. With k
the direction of travel at the receiver and L the unfolded length, moving things shifts the end of the vector
L k by s, and

    L' = |L k + s|,    k' = (L k + s) / L'.

A receiver that moves by d gives s = d; a transmitter -M d, with M the product of the mirrors H = I - 2 n n^T
on the way; a wall that moves by d gives minus its image's shift 2 (n.d) n, mirrored by the walls after it.
All differences are formed so that nothing moves exactly nothing. What the new geometry does to the reflection
coefficients is neglected. Where the known mirrors do not lead from one direction to the other, at an edge or on a path of
which another ray tracer does not say how it goes, one more mirror does: lengths are right to first order. Source: image
method, e.g. ITU-R P.1407 and any text on ray tracing.

What every effect that moves something asks is traced once for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int
from scipy.constants import speed_of_light

from dtprob.effects.common import Sites, meets, of_model
from dtprob.effects.effect import Rewrite
from dtprob.raytracing.paths import SPECULAR, PathSet

_TURNED: Final = 1e-3
"""Angle, rad, from which on a path is said to turn where no mirror is known."""

type Shift = Callable[[PathSet, Mapping[str, Any]], Float[Array, "link path 3"]]
"""The shift s of the unfolded end of every path, from the paths and the effect's parameters."""


class Moved(NamedTuple):
    """What a shift does to a path: added length in m, and added vectors of arrival and departure."""

    stretch: Float[Array, "link path"]
    arrival: Float[Array, "link path 3"]
    departure: Float[Array, "link path 3"]


@jax.jit
def moved(paths: PathSet, shift: Float[Array, "link path 3"]) -> Moved:
    """Change of length and directions of every path; zero where there is no path."""
    length, direction = jnp.where(paths.mask, paths.length, 1.0), jnp.asarray(paths.arrival)
    shift = jnp.where(jnp.asarray(paths.mask)[..., None], shift, 0.0)
    excess = 2 * length * jnp.sum(direction * shift, -1) + jnp.sum(shift**2, -1)
    new = jnp.sqrt(length**2 + excess)
    stretch = excess / (new + length)
    turn = (shift - stretch[..., None] * direction) / new[..., None]
    return Moved(stretch, turn, to_transmitter(paths, turn))


def rewrites(sites: Sites, shift: Shift) -> dict[str, Rewrite]:
    """Rewrites of delay, directions and free-space loss, for those of the four sites that the model has."""

    def change(p: Mapping[str, Any], context: Mapping[str, Any]) -> Moved:
        paths = context["paths"]
        return moved(paths, shift(paths, p))

    def gain(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        length = jnp.where(context["paths"].mask, context["paths"].length, 1.0)
        return value / (1.0 + change(p, context).stretch / length)

    table: dict[str, Rewrite] = {
        "path_delay": lambda value, p, context: value + change(p, context).stretch / speed_of_light,
        "departure": lambda value, p, context: value + change(p, context).departure,
        "arrival": lambda value, p, context: value + change(p, context).arrival,
        "path_gain": gain,
    }
    return of_model(sites, table)


@jax.jit
def of_receiver(paths: PathSet, displacement: Float[Array, "*link 3"]) -> Float[Array, "link path 3"]:
    """Shift by a receiver that moves, (3,) for all links alike or (link, 1, 3)."""
    return jnp.broadcast_to(displacement, paths.arrival.shape)


@jax.jit
def of_transmitter(paths: PathSet, displacement: Float[Array, "*link 3"]) -> Float[Array, "link path 3"]:
    """Shift by a transmitter that moves, (3,) for all links alike or (link, 1, 3)."""
    vector = mirror(jnp.broadcast_to(displacement, paths.arrival.shape), *_unknown_mirror(paths))
    for step in range(paths.depth):
        vector = mirror(vector, paths.normal[:, :, step], _reflects(paths, step))
    return -vector


@jax.jit
def of_object(
    paths: PathSet, index: int | Int[Array, ""], displacement: Float[Array, "*link_path_depth 3"]
) -> Float[Array, "link path 3"]:
    """Shift by an object whose points of reflection move, (3,) for all alike or (link, path, depth, 3)."""
    moves = meets(paths, index, (SPECULAR,))
    each = jnp.broadcast_to(displacement, paths.normal.shape)
    image = jnp.zeros_like(paths.arrival)
    for step in range(paths.depth):
        normal = paths.normal[:, :, step]
        height = jnp.sum(normal * each[:, :, step], -1)
        image = mirror(image, normal, _reflects(paths, step))
        image = image + jnp.where(moves[:, :, step], 2 * height, 0.0)[..., None] * normal
    return -image


@jax.jit
def to_transmitter(paths: PathSet, vector: Float[Array, "link path 3"]) -> Float[Array, "link path 3"]:
    """A vector at the receiver as the transmitter sees it, through all mirrors backwards."""
    return mirror(_through_known(paths, vector), *_unknown_mirror(paths))


def _through_known(paths: PathSet, vector: Float[Array, "link path 3"]) -> Float[Array, "link path 3"]:
    for step in reversed(range(paths.depth)):
        vector = mirror(vector, paths.normal[:, :, step], _reflects(paths, step))
    return vector


def _unknown_mirror(paths: PathSet) -> tuple[Float[Array, "link path 3"], Bool[Array, "link path"]]:
    """Normal of the mirror that is missing between the directions of departure and arrival, and where one is."""
    turn = _through_known(paths, jnp.asarray(paths.arrival)) - jnp.asarray(paths.departure)
    size = jnp.linalg.norm(turn, axis=-1)
    missing = size > _TURNED
    return turn / jnp.where(missing, size, 1.0)[..., None], missing


def mirror(
    vector: Float[Array, "link path 3"], normal: Float[Array, "link path 3"], where: Bool[Array, "link path"]
) -> Float[Array, "link path 3"]:
    """H v = v - 2 (n.v) n where asked, v elsewhere."""
    twice = jnp.where(where, 2 * jnp.sum(normal * vector, -1), 0.0)
    return vector - twice[..., None] * normal


def _reflects(paths: PathSet, step: int) -> Bool[Array, "link path"]:
    return jnp.asarray(paths.interaction)[:, :, step] == SPECULAR
