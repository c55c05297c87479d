"""The paths of a rectangular room by the image method: a scene of known geometry that needs no ray tracer."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.constants import speed_of_light

from dtprob.errors import InputError
from dtprob.raytracing.geometry import unfold
from dtprob.raytracing.paths import NONE, SPECULAR, PathSet, validate

SIZE = np.asarray([9.0, 7.0, 3.2])
"""Length, width and height, m."""
_NAMES = ("west", "east", "south", "north", "floor", "ceiling")
_UP = np.asarray([0.1, 0.2, 1.0])
# The planes met by each path: line of sight, then west, north, floor, east, south, then corners.
_MET: tuple[tuple[int, ...], ...] = ((), (0,), (3,), (4,), (1,), (2,), (0, 3), (1, 2))
MOST_PATHS = len(_MET)


def room_paths(
    links: int,
    paths: int,
    *,
    frequency: float = 6.0e9,
    permittivity: float = 5.0,
    conductivity: float = 0.1,
    seed: int = 0,
) -> PathSet:
    """Line of sight and reflections between one transmitter and receivers at random places of a room.

    Args:
        links: number of receivers.
        paths: number of paths of each link, line of sight first, then up to two reflections.
        frequency: carrier, Hz.
        permittivity: relative, of walls, floor and ceiling, which are of one material.
        conductivity: S/m, of the same.
        seed: of the receivers' places.

    Raises:
        InputError: more paths than the room has here, or none.
    """
    if not 1 <= paths <= MOST_PATHS:
        raise InputError("paths of a room", f"1 to {MOST_PATHS}", str(paths), "Ask for fewer")
    random = np.random.default_rng(seed)
    rx = SIZE * random.uniform(0.15, 0.85, (links, 3))
    tx = np.repeat([[1.3, 2.1, 2.4]], links, axis=0)
    met = np.asarray([[*planes, 0, 0][:2] for planes in _MET[:paths]])
    code = np.asarray([[SPECULAR] * len(planes) + [NONE] * (2 - len(planes)) for planes in _MET[:paths]])
    objects, code = (np.broadcast_to(array, (links, paths, 2)) for array in (met, code))
    normal = np.repeat(np.eye(3), 2, axis=0)
    point = normal * np.asarray([0.0, 1.0] * 3)[:, None] * SIZE
    flat = (-1, 2, 3)
    found = unfold(
        np.repeat(tx, paths, axis=0),
        np.repeat(rx, paths, axis=0),
        code.reshape(-1, 2),
        normal[objects].reshape(flat),
        point[objects].reshape(flat),
    )
    length = found.length.reshape(links, paths)
    arrival, departure = (way.reshape(links, paths, 3) for way in (found.arrival, found.departure))
    return validate(
        PathSet(
            delay=jnp.asarray(length / speed_of_light),
            carrier_phasor=jnp.exp(-2j * np.pi * np.mod(frequency * length / speed_of_light, 1.0)),
            departure=jnp.asarray(departure),
            arrival=jnp.asarray(arrival),
            mask=jnp.ones((links, paths), bool),
            interaction=jnp.asarray(code),
            object=jnp.asarray(objects),
            vertex=jnp.asarray(found.vertex.reshape(links, paths, 2, 3)),
            normal=jnp.asarray(normal[objects]),
            length=jnp.asarray(length),
            tx_field=jnp.asarray(_across(departure)),
            rx_field=jnp.asarray(_across(arrival)),
            rx_position=jnp.asarray(rx),
            tx_position=jnp.asarray(tx),
            object_material=jnp.zeros(6, int),
            permittivity=jnp.full(6, permittivity),
            conductivity=jnp.full(6, conductivity),
            thickness=jnp.full(6, 0.2),
            frequency=frequency,
            object_names=_NAMES,
            material_names=("concrete",),
        )
    )


def _across(direction: Float[np.ndarray, "link path 3"]) -> Float[np.ndarray, "link path 3"]:
    """The nearly vertical unit vector across each direction."""
    vector = _UP - np.sum(_UP * direction, -1, keepdims=True) * direction
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
