"""What is really out there: the scene, its materials, where the antennas stand and how they are turned.

A `World` is a description and nothing else. Edits give a new one; `dtprob.physical.tracing.trace` makes its
paths.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.errors import InputError

SPEED_OF_LIGHT: Final = 299_792_458.0
"""m/s."""


@dataclass(frozen=True)
class Material:
    """A homogeneous slab.

    Attributes:
        permittivity: relative, at least 1.
        conductivity: S/m.
        thickness: m; None keeps what the scene has.
    """

    permittivity: float
    conductivity: float
    thickness: float | None = None


@dataclass(frozen=True)
class Part:
    """An object that the scene file does not have.

    Attributes:
        mesh: PLY file.
        position: of the centre of its box, m.
        scaling: factor on the mesh's size.
        material: what it is made of.
    """

    mesh: str
    position: tuple[float, float, float]
    material: Material
    scaling: float = 1.0


@dataclass(frozen=True)
class World:
    """The physical truth of a measurement campaign with one transmitter and one receiver per link.

    Attributes:
        scene: a scene that sionna-rt ships, by name, or a Mitsuba XML file.
        frequency: carrier in Hz.
        tx_position: of each link, m.
        rx_position: of each link, m.
        tx_array: elements from the array's centre in m, before it is turned.
        rx_array: likewise.
        materials: true values per material class of the scene; classes not named keep the scene's.
        object_materials: true values of single objects that differ from their class.
        moved: displacement of objects in m.
        turned: rotation of objects about the vertical through their centre, rad.
        removed: objects of the scene that are not there.
        parts: objects that are there and not in the scene, by name.
        tx_turn: yaw, pitch and roll of every transmitting array, rad.
        rx_turn: likewise.
        rx_slant: rotation of each receiving element's polarization about the x-axis of its array, in rad; the
            elements stay where they are.
        max_depth: largest number of reflections.
        rays: rays shot per transmitter to find the paths.
    """

    scene: str
    frequency: float
    tx_position: Float[np.ndarray, "link 3"]
    rx_position: Float[np.ndarray, "link 3"]
    tx_array: Float[np.ndarray, "tx_antenna 3"]
    rx_array: Float[np.ndarray, "rx_antenna 3"]
    materials: Mapping[str, Material] = field(default_factory=dict[str, Material])
    object_materials: Mapping[str, Material] = field(default_factory=dict[str, Material])
    moved: Mapping[str, tuple[float, float, float]] = field(
        default_factory=dict[str, tuple[float, float, float]]
    )
    turned: Mapping[str, float] = field(default_factory=dict[str, float])
    removed: tuple[str, ...] = ()
    parts: Mapping[str, Part] = field(default_factory=dict[str, Part])
    tx_turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rx_turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rx_slant: float = 0.0
    max_depth: int = 3
    rays: int = 200_000

    def __post_init__(self) -> None:
        for name in ("tx_position", "rx_position", "tx_array", "rx_array"):
            value = np.asarray(getattr(self, name), np.float64)
            if value.ndim != 2 or value.shape[1] != 3:
                raise InputError(
                    f"world.{name}", "shape (n, 3) in m", str(value.shape), "Give three coordinates each"
                )
            object.__setattr__(self, name, value)
        if self.tx_position.shape != self.rx_position.shape:
            got = f"{len(self.tx_position)} and {len(self.rx_position)}"
            raise InputError(
                "world", "a transmitter and a receiver per link", got, "Repeat the one that stays"
            )

    @property
    def wavelength(self) -> float:
        """Of the carrier, m."""
        return SPEED_OF_LIGHT / self.frequency

    @property
    def n_link(self) -> int:
        """Number of links."""
        return len(self.rx_position)

    def trace_key(self) -> str:
        """Digest of all that the traced paths depend on; the arrays do not count, one element is traced."""
        digest = hashlib.sha256()
        for entry in dataclasses.fields(self):
            if entry.name in ("tx_array", "rx_array"):
                continue
            value = getattr(self, entry.name)
            content = value.tobytes() if isinstance(value, np.ndarray) else _plain(value).encode()
            digest.update(entry.name.encode() + b"=" + content + b";")
        return digest.hexdigest()


def _plain(value: object) -> str:
    return repr(sorted(value.items())) if isinstance(value, Mapping) else repr(value)


def move_object(world: World, name: str, vector: Sequence[float]) -> World:
    """The world with one object displaced by a vector, in m, on top of what moved it before."""
    before = world.moved.get(name, (0.0, 0.0, 0.0))
    x, y, z = (float(old + new) for old, new in zip(before, vector, strict=True))
    return dataclasses.replace(world, moved={**world.moved, name: (x, y, z)})


def turn_object(world: World, name: str, angle: float) -> World:
    """The world with one object turned about the vertical through its centre, in rad."""
    return dataclasses.replace(world, turned={**world.turned, name: world.turned.get(name, 0.0) + angle})


def remove_object(world: World, name: str) -> World:
    """The world without one object of the scene."""
    return dataclasses.replace(world, removed=tuple(sorted({*world.removed, name})))


def add_object(world: World, name: str, part: Part) -> World:
    """The world with one more object."""
    if name in world.parts:
        raise InputError("object to add", "a new name", repr(name), "Choose another name")
    return dataclasses.replace(world, parts={**world.parts, name: part})


def swap_material(world: World, name: str, material: Material) -> World:
    """The world in which one object is made of something else than its class."""
    return dataclasses.replace(world, object_materials={**world.object_materials, name: material})


def set_materials(world: World, materials: Mapping[str, Material]) -> World:
    """The world with other true values for whole classes of materials."""
    return dataclasses.replace(world, materials={**world.materials, **materials})


def displace_receivers(world: World, vector: Float[np.ndarray, "*link 3"]) -> World:
    """The world with every receiver displaced, by one vector or by one per link, in m."""
    return dataclasses.replace(world, rx_position=world.rx_position + np.asarray(vector, np.float64))


def displace_transmitters(world: World, vector: Float[np.ndarray, "*link 3"]) -> World:
    """The world with every transmitter displaced, by one vector or by one per link, in m."""
    return dataclasses.replace(world, tx_position=world.tx_position + np.asarray(vector, np.float64))


def rotation(turn: Sequence[float]) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix of yaw, pitch and roll (rad), about z, y and x in the frame fixed to the body.

    Source: 3GPP TR 38.901, eq. (7.1-4).
    """
    yaw, pitch, roll = (float(angle) for angle in turn)
    about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    about_y = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    return about_z @ about_y @ about_x


def planar_array(rows: int, columns: int, spacing: float) -> Float[np.ndarray, "antenna 3"]:
    """Elements of a planar array in the y-z plane, row by row from the top, centred; `spacing` in m."""
    z = (rows - 1) / 2 - np.arange(rows)
    y = np.arange(columns) - (columns - 1) / 2
    grid = np.stack(np.meshgrid(z, y, indexing="ij"), axis=-1).reshape(-1, 2) * spacing
    return np.stack([np.zeros(len(grid)), grid[:, 1], grid[:, 0]], axis=-1)
