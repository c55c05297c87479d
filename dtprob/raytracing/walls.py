"""A path set written down: one reflection on each of several upright walls beside a link, no ray tracer needed."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from scipy.constants import speed_of_light

from dtprob.errors import InputError
from dtprob.raytracing.geometry import unfold
from dtprob.raytracing.paths import SPECULAR, PathSet, validate


def between_walls(distance: float, walls: Sequence[float], frequency: float) -> PathSet:
    """Single reflections of a link along x on walls of one material parallel to it; the line of sight is blocked.

    The antennas are isotropic and vertically polarised, so that the field is across every plane of incidence. The walls
    are 10 cm of concrete as it is at 6 GHz (ITU-R P.2040-1).

    Args:
        distance: from transmitter, at the origin, to receiver, m.
        walls: y of each wall, not 0, m.
        frequency: carrier, Hz.

    Raises:
        InputError: no wall, or one through the antennas.
    """
    at = np.asarray(walls, np.float64)
    if not at.size or np.any(at == 0):
        raise InputError("walls", "distances that are not 0, one or more", str(list(walls)), "Move the walls")
    count = len(at)
    tx, rx = np.zeros((count, 3)), np.tile([distance, 0.0, 0.0], (count, 1))
    normal = np.tile([0.0, 1.0, 0.0], (count, 1, 1))
    hit = np.full((count, 1), SPECULAR)
    point = np.stack([np.full(count, distance / 2), at, np.zeros(count)], axis=1)[:, None]
    geometry = unfold(tx, rx, hit, normal, point)
    geometry = geometry.chosen(np.argsort(geometry.length, kind="stable"))
    delay = geometry.length / speed_of_light
    up = np.tile([0.0, 0.0, 1.0], (1, count, 1))
    return validate(
        PathSet(
            delay=jnp.asarray(delay[None]),
            carrier_phasor=jnp.asarray(np.exp(-2j * np.pi * np.mod(frequency * delay, 1.0))[None]),
            departure=jnp.asarray(geometry.departure[None]),
            arrival=jnp.asarray(geometry.arrival[None]),
            mask=jnp.ones((1, count), bool),
            interaction=jnp.asarray(hit[None], jnp.int32),
            object=jnp.asarray(np.argsort(np.abs(at), kind="stable")[None, :, None], jnp.int32),
            vertex=jnp.asarray(geometry.vertex[None]),
            normal=jnp.asarray(normal[None]),
            length=jnp.asarray(geometry.length[None]),
            tx_field=jnp.asarray(up),
            rx_field=jnp.asarray(up),
            rx_position=jnp.asarray(rx[:1]),
            tx_position=jnp.asarray(tx[:1]),
            object_material=jnp.zeros(count, jnp.int32),
            permittivity=jnp.full(count, 5.31),
            conductivity=jnp.full(count, 0.139),
            thickness=jnp.full(count, 0.1),
            frequency=frequency,
            object_names=tuple(f"wall_{number}" for number in range(count)),
            material_names=("concrete",),
            provenance=(("solver", "by hand"),),
        )
    )
