"""From a list of traced paths to a `PathSet`: exact geometry, antennas, one row per link."""

from dataclasses import dataclass
from importlib.metadata import version
from typing import Final, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.constants import speed_of_light

from dtprob.errors import InputError, unknown_name
from dtprob.raytracing.geometry import Geometry, unfold
from dtprob.raytracing.paths import NONE, PathSet, validate
from dtprob.raytracing.pattern import PATTERNS, field_vector, slant_angle
from dtprob.raytracing.solve import Objects, Settings

SAME: Final = 1e-4
"""Two paths by way of the same objects whose unfolded ends lie closer than this, in m, are one."""


class Flat(NamedTuple):
    """Paths of all links one after another; identifiers as the solver has them."""

    link: Int[np.ndarray, " n"]
    interaction: Int[np.ndarray, "n depth"]
    object: Int[np.ndarray, "n depth"]
    primitive: Int[np.ndarray, "n depth"]
    vertex: Float[np.ndarray, "n depth 3"]

    def turned(self) -> "Flat":
        """The same paths run from the other end."""
        count = np.count_nonzero(self.interaction != NONE, axis=1)[:, None]
        steps = np.arange(self.interaction.shape[1])[None]
        order = np.where(steps < count, count - 1 - steps, steps)

        def along(value: np.ndarray) -> np.ndarray:
            return np.take_along_axis(value, order.reshape(*order.shape, *[1] * (value.ndim - 2)), axis=1)

        return Flat(
            self.link, along(self.interaction), along(self.object), along(self.primitive), along(self.vertex)
        )

    def chosen(self, order: Int[np.ndarray, " m"]) -> "Flat":
        """Some of the paths, in this order."""
        return Flat(
            self.link[order],
            self.interaction[order],
            self.object[order],
            self.primitive[order],
            self.vertex[order],
        )


@dataclass(frozen=True)
class Antenna:
    """A single element.

    Attributes:
        pattern: name of its pattern.
        polarization: V, H, or slant angle in rad.
        orientation: rotations about z, y and x in rad, shared or per link.
    """

    pattern: str
    polarization: str | float
    orientation: Float[np.ndarray, "*link 3"] | tuple[float, float, float]

    def checked(self, n_link: int) -> "Antenna":
        """The antenna itself; raises InputError when its pattern or polarisation does not exist, its angles do not fit."""
        if self.pattern not in PATTERNS:
            raise unknown_name("antenna pattern", self.pattern, PATTERNS, "pattern")
        slant_angle(self.polarization)
        shape = np.shape(self.orientation)
        if shape not in {(3,), (n_link, 3)}:
            expected = f"three angles in rad, or three for each of {n_link} links"
            raise InputError("orientation of an antenna", expected, f"shape {shape}", "Correct it")
        return self

    def field(
        self, direction: Float[np.ndarray, "n 3"], link: Int[np.ndarray, " n"], n_link: int
    ) -> Float[np.ndarray, "n 3"]:
        """Field vector towards each direction, for the element of each link."""
        orientation = np.broadcast_to(np.asarray(self.orientation, np.float64), (n_link, 3))[link]
        vector = field_vector(
            jnp.asarray(direction),
            pattern=self.pattern,
            polarization=self.polarization,
            orientation=jnp.asarray(orientation),
        )
        return np.asarray(vector, np.float64)


def assemble(
    flat: Flat,
    objects: Objects,
    *,
    tx: Float[np.ndarray, "link 3"],
    rx: Float[np.ndarray, "link 3"],
    antennas: tuple[Antenna, Antenna],
    frequency: float,
    settings: Settings,
) -> PathSet:
    """Build the path set, the paths of each link from the shortest to the longest.

    Args:
        flat: what the solver found.
        objects: of the scene.
        tx: transmitter of each link, m.
        rx: receiver of each link, m.
        antennas: transmitting and receiving element.
        frequency: carrier in Hz.
        settings: of the solver, for the record.
    """
    flat, index, normal, geometry = _exact(flat, objects, tx, rx)
    delay = geometry.length / speed_of_light
    rows = _Rows(flat.link, len(tx))
    return validate(
        PathSet(
            delay=rows.fill(delay, 0.0),
            carrier_phasor=rows.fill(np.exp(-2j * np.pi * np.mod(frequency * delay, 1.0)), 1.0),
            departure=rows.fill(geometry.departure, (0.0, 0.0, 1.0)),
            arrival=rows.fill(geometry.arrival, (0.0, 0.0, 1.0)),
            mask=rows.fill(np.ones(len(delay), bool), fill=False),
            interaction=rows.fill(flat.interaction, 0),
            object=rows.fill(index, 0),
            vertex=rows.fill(geometry.vertex, 0.0),
            normal=rows.fill(normal, (0.0, 0.0, 1.0)),
            length=rows.fill(geometry.length, 1.0),
            tx_field=rows.fill(antennas[0].field(geometry.departure, flat.link, len(tx)), 0.0),
            rx_field=rows.fill(antennas[1].field(-geometry.arrival, flat.link, len(tx)), 0.0),
            rx_position=jnp.asarray(rx),
            tx_position=jnp.asarray(tx),
            object_material=jnp.asarray(objects.material, jnp.int32),
            permittivity=jnp.asarray(objects.permittivity),
            conductivity=jnp.asarray(objects.conductivity),
            thickness=jnp.asarray(objects.thickness),
            frequency=frequency,
            object_names=objects.names,
            material_names=objects.material_names,
            object_center=jnp.asarray(objects.center),
            scattering=jnp.asarray(objects.scattering) if np.any(objects.scattering) else None,
            provenance=_provenance(objects, antennas, settings),
        )
    )


def _exact(
    flat: Flat, objects: Objects, tx: Float[np.ndarray, "link 3"], rx: Float[np.ndarray, "link 3"]
) -> tuple[Flat, Int[np.ndarray, "n depth"], Float[np.ndarray, "n depth 3"], Geometry]:
    """Paths by link and length, each once, with the objects and normals they meet and their geometry."""
    index, normal = _surfaces(flat, objects)
    geometry = unfold(tx[flat.link], rx[flat.link], flat.interaction, normal, flat.vertex)
    order = np.lexsort((geometry.length, flat.link))
    unfolded = geometry.arrival * geometry.length[:, None]
    order = order[~_repeated(flat.chosen(order), index[order], unfolded[order])]
    return flat.chosen(order), index[order], normal[order], geometry.chosen(order)


class _Rows:
    """Where each path goes in arrays of one row per link."""

    def __init__(self, link: Int[np.ndarray, " n"], n_link: int) -> None:
        count = np.bincount(link, minlength=n_link)
        first = np.cumsum(count) - count
        self._place = link, np.arange(len(link)) - first[link]
        self._shape = n_link, max(1, int(count.max(initial=0)))

    def fill(self, value: np.ndarray, fill: complex | bool | tuple[float, ...]) -> Array:
        """Spread a value per path over the rows, `fill` where there is no path."""
        kind = np.int32 if value.dtype.kind == "i" else value.dtype
        table = np.empty((*self._shape, *value.shape[1:]), kind)
        table[...] = fill
        table[self._place] = value
        return jnp.asarray(table)


def _surfaces(
    flat: Flat, objects: Objects
) -> tuple[Int[np.ndarray, "n depth"], Float[np.ndarray, "n depth 3"]]:
    """Object and normal of the face at each interaction; object 0 and the z axis where there is none."""
    hit = flat.interaction != NONE
    order = np.argsort(objects.identifier)
    place = np.searchsorted(
        objects.identifier[order], np.where(hit, flat.object, objects.identifier[order[0]])
    )
    index = np.where(hit, order[place], 0)
    normal = np.broadcast_to((0.0, 0.0, 1.0), (*hit.shape, 3)).copy()
    normal[hit] = objects.normal[objects.first_face[index[hit]] + flat.primitive[hit]]
    return index, normal


def _repeated(
    flat: Flat, index: Int[np.ndarray, "n depth"], unfolded: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Which paths are there already, earlier in the list of their link.

    The solver tells mirrors apart by a rounded plane, so that a wall whose triangles round differently may
    reflect twice.
    """
    again = np.zeros(len(flat.link), bool)
    steps = np.concatenate([flat.interaction, index], axis=1)
    bounds = np.flatnonzero(np.diff(flat.link)) + 1
    for rows in np.split(np.arange(len(flat.link)), bounds):
        same = np.all(steps[rows, None] == steps[None, rows], axis=-1)
        same &= np.linalg.norm(unfolded[rows, None] - unfolded[None, rows], axis=-1) < SAME
        again[rows] = np.any(np.tril(same, -1), axis=1)
    return again


def _provenance(
    objects: Objects, antennas: tuple[Antenna, Antenna], settings: Settings
) -> tuple[tuple[str, str], ...]:
    sending, receiving = antennas
    return (
        ("solver", f"sionna-rt {version('sionna-rt')}"),
        ("scene_sha256", objects.sha256),
        ("max_depth", str(settings.max_depth)),
        ("refraction", str(settings.refraction).lower()),
        ("samples", str(settings.samples)),
        ("seed", str(settings.seed)),
        ("tx_pattern", sending.pattern),
        ("rx_pattern", receiving.pattern),
        ("tx_polarization", str(sending.polarization)),
        ("rx_polarization", str(receiving.polarization)),
    )
