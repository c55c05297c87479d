"""Impairments of place: things that are not where, how or what the scene says. All are traced again."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from dtprob.physical.channel import Sounding, synthesise
from dtprob.physical.impairment import Columns, Impairment
from dtprob.physical.rays import Rays
from dtprob.physical.world import (
    Material,
    World,
    displace_receivers,
    displace_transmitters,
    move_object,
    swap_material,
    turn_object,
)


def receiver_displacement(direction: Float[np.ndarray, "*link 3"], limit: float = 1.0) -> Impairment:
    """Receivers stand elsewhere by size times a direction, one for all or one per link; size in m."""
    return Impairment(
        "receiver_displacement",
        "m",
        limit,
        world=lambda world, size: displace_receivers(world, size * direction),
        detail={"direction": direction.tolist()},
    )


def receiver_scatter(draw: Float[np.ndarray, "link 3"], limit: float = 0.5) -> Impairment:
    """Every receiver stands elsewhere by a random vector of its own; size is the deviation per axis in m.

    Args:
        draw: standard normal.
        limit: of the size.
    """

    def spread(world: World, rays: Rays, sounding: Sounding, size: float) -> Columns:
        step = 1e-4 * world.wavelength
        clean = synthesise(world, rays, sounding)
        moved = [
            synthesise(world, rays.shifted(step * np.eye(3)[axis, None, None]), sounding) for axis in range(3)
        ]
        each = np.stack([(channel - clean) * (size / step) for channel in moved], axis=1)
        return each.reshape(*each.shape[:2], -1)

    return Impairment(
        "receiver_displacement",
        "m",
        limit,
        instance="each_link",
        world=lambda world, size: displace_receivers(world, size * draw),
        spread=spread,
    )


def transmitter_displacement(direction: Float[np.ndarray, "*link 3"], limit: float = 1.0) -> Impairment:
    """Transmitters stand elsewhere by size times a direction; size in m."""
    return Impairment(
        "transmitter_displacement",
        "m",
        limit,
        world=lambda world, size: displace_transmitters(world, size * direction),
        detail={"direction": direction.tolist()},
    )


def object_displacement(name: str, direction: Sequence[float], limit: float = 1.0) -> Impairment:
    """An object stands elsewhere by size times a direction; size in m."""
    x, y, z = (float(value) for value in direction)
    return Impairment(
        "object_displacement",
        "m",
        limit,
        instance=name,
        world=lambda world, size: move_object(world, name, (size * x, size * y, size * z)),
        detail={"direction": [x, y, z]},
    )


def object_rotation(name: str, limit: float = 0.1) -> Impairment:
    """An object is turned about the vertical through its centre; size in rad."""
    return Impairment(
        "object_rotation",
        "rad",
        limit,
        instance=name,
        world=lambda world, size: turn_object(world, name, size),
    )


def material_mismatch(
    name: str, nominal: Material, direction: tuple[float, float], limit: float = 1.0
) -> Impairment:
    """One object is made of something else than its class.

    Args:
        name: of the object.
        nominal: what its class is made of.
        direction: the logarithms of permittivity - 1 and of conductivity change by size times these.
        limit: of the size, a pure number.
    """

    def swap(world: World, size: float) -> World:
        permittivity = 1 + (nominal.permittivity - 1) * float(np.exp(size * direction[0]))
        conductivity = nominal.conductivity * float(np.exp(size * direction[1]))
        return swap_material(world, name, Material(permittivity, conductivity, nominal.thickness))

    return Impairment(
        "material_mismatch",
        "1",
        limit,
        instance=name,
        world=lambda world, size: swap(world, size) if size else world,
        detail={"log_contrast": direction[0], "log_conductivity": direction[1]},
    )


def thickness_mismatch(name: str, nominal: Material, limit: float = 0.1) -> Impairment:
    """The walls of one object are thicker than recorded by `size` m."""
    before = nominal.thickness or 0.0

    def thicken(world: World, size: float) -> World:
        return (
            swap_material(world, name, dataclasses.replace(nominal, thickness=before + size))
            if size
            else world
        )

    return Impairment("thickness_mismatch", "m", limit, instance=name, world=thicken)


def antenna_orientation(axis: Sequence[float], limit: float = 0.5) -> Impairment:
    """The receiving arrays are turned, polarization too, by size times (yaw, pitch, roll); size in rad."""
    yaw, pitch, roll = (float(value) for value in axis)

    def turn(world: World, size: float) -> World:
        before = world.rx_turn
        return dataclasses.replace(
            world, rx_turn=(before[0] + size * yaw, before[1] + size * pitch, before[2] + size * roll)
        )

    return Impairment(
        "antenna_orientation", "rad", limit, instance="rx", world=turn, detail={"axis": [yaw, pitch, roll]}
    )


def polarization_mismatch(limit: float = 0.8) -> Impairment:
    """Every receiving element is slanted where it stands; size in rad."""
    return Impairment(
        "polarization_mismatch",
        "rad",
        limit,
        instance="rx",
        world=lambda world, size: dataclasses.replace(world, rx_slant=world.rx_slant + size),
    )


def element_spacing(limit: float = 0.5) -> Impairment:
    """The elements of the receiving arrays are spaced more widely, by the fraction `size`."""
    return Impairment(
        "element_spacing",
        "1",
        limit,
        instance="rx",
        world=lambda world, size: dataclasses.replace(world, rx_array=world.rx_array * (1 + size)),
    )
