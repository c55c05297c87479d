"""The propagation paths of a traced scene, as one frozen pytree that needs no ray tracer."""

from collections.abc import Mapping
from typing import Any, Final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int, Shaped
from scipy.constants import speed_of_light

from dtprob.errors import InputError

NONE: Final = 0
SPECULAR: Final = 1
DIFFUSE: Final = 2
REFRACTION: Final = 4
DIFFRACTION: Final = 8
INTERACTIONS: Final = {
    NONE: "none",
    SPECULAR: "specular reflection",
    DIFFUSE: "diffuse reflection",
    REFRACTION: "refraction",
    DIFFRACTION: "diffraction",
}
_STRAIGHT: Final = 1 - 1e-6
"""Cosine of the angle between departure and arrival from which on a path is straight."""

_OFF: Final = 1e-2
"""Share of a length by which it may differ from the delay's, or fall short of the straight line."""
_TURNED: Final = 1e-2
"""How far a phasor of the carrier may be from that of the delay."""


class PathSet(eqx.Module):
    """The paths of several links, padded to a common number and depth; `mask` tells which exist.

    Where a path or an interaction is missing, every array holds a harmless finite value, never NaN or -1.
    The channel they make is h(f_k) = sum_p a_p exp(-j 2 pi (f_c + f_k) tau_p).

    Attributes:
        delay: tau_p in s, computed in double precision from the geometry.
        carrier_phasor: exp(-j 2 pi f_c tau_p), computed in double precision; use it for the phase of the
            carrier, because f_c tau_p in single precision keeps no phase.
        departure: unit vector of travel on leaving the transmitter.
        arrival: unit vector of travel at the receiver, pointing towards it.
        mask: which paths exist.
        interaction: what happens at each step: 0 none, 1 specular reflection, 2 diffuse reflection,
            4 refraction, 8 diffraction (the codes of Sionna RT).
        object: index into `object_names`; 0 where `interaction` is 0.
        vertex: point of each interaction, in m.
        normal: unit normal of the surface there, of either sign.
        length: unfolded length of the path in m.
        tx_field: field vector of the transmitting element in the direction of departure, in world axes.
        rx_field: field vector of the receiving element towards the arriving wave, in world axes.
        rx_position: of each link, in m.
        tx_position: of each link, in m.
        object_material: index into `material_names`, per object.
        permittivity: relative permittivity of each object as the scene has it.
        conductivity: in S/m, as the scene has it.
        thickness: of the slab that each object is, in m, as the scene has it.
        frequency: carrier f_c in Hz.
        object_names: names of the objects of the scene.
        material_names: names of its materials.
        scattering: scattering coefficient S per object, or None when all are 0; a specular reflection is
            weakened by sqrt(1 - S^2).
        object_center: centre of each object's bounding box, in m; None where only its points of reflection are known.
        beyond: 0 for the paths of the set itself; k for paths that only another trace has, `beyond_names[k - 1]`. These
            are masked, as if missing, but their arrays hold true values (see `dtprob.raytracing.beyond`). None
            where there are none.
        beyond_names: what the other traces had that this one had not.
        provenance: pairs of name and value that say where the paths come from (scene, solver, settings).
    """

    delay: Float[Array, "link path"]
    carrier_phasor: Complex[Array, "link path"]
    departure: Float[Array, "link path 3"]
    arrival: Float[Array, "link path 3"]
    mask: Bool[Array, "link path"]
    interaction: Int[Array, "link path depth"]
    object: Int[Array, "link path depth"]
    vertex: Float[Array, "link path depth 3"]
    normal: Float[Array, "link path depth 3"]
    length: Float[Array, "link path"]
    tx_field: Shaped[Array, "link path 3"]
    rx_field: Shaped[Array, "link path 3"]
    rx_position: Float[Array, "link 3"]
    tx_position: Float[Array, "link 3"]
    object_material: Int[Array, " object"]
    permittivity: Float[Array, " object"]
    conductivity: Float[Array, " object"]
    thickness: Float[Array, " object"]
    frequency: float = eqx.field(static=True)
    object_names: tuple[str, ...] = eqx.field(static=True)
    material_names: tuple[str, ...] = eqx.field(static=True)
    scattering: Float[Array, " object"] | None = None
    object_center: Float[Array, "object 3"] | None = None
    beyond: Int[Array, "link path"] | None = None
    beyond_names: tuple[str, ...] = eqx.field(static=True, default=())
    provenance: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())

    @property
    def n_link(self) -> int:
        """Number of links."""
        return self.delay.shape[0]

    @property
    def n_path(self) -> int:
        """Number of paths per link, missing ones included."""
        return self.delay.shape[1]

    @property
    def depth(self) -> int:
        """Largest number of interactions on a path."""
        return self.interaction.shape[2]

    @property
    def is_untold(self) -> Bool[Array, "link path"]:
        """Which paths turn although no interaction says where, as those of other ray tracers do."""
        along = jnp.sum(jnp.asarray(self.departure) * jnp.asarray(self.arrival), axis=-1)
        return (along < _STRAIGHT) & jnp.all(jnp.asarray(self.interaction) == NONE, axis=-1)

    @property
    def n_object(self) -> int:
        """Number of objects in the scene."""
        return self.object_material.shape[0]

    @property
    def n_material(self) -> int:
        """Number of materials in the scene."""
        return len(self.material_names)

    @property
    def wavelength(self) -> float:
        """Wavelength of the carrier in m."""
        return speed_of_light / self.frequency

    def take(self, links: Int[Any, " chosen"]) -> "PathSet":
        """The path set of some links, in the order given; objects and materials stay.

        Args:
            links: indices of links, or a boolean mask over them.

        Raises:
            InputError: an index names no link, or a mask is of another number of links.
        """
        index = np.asarray(links)
        if index.dtype == bool and index.shape == (self.n_link,):
            index = np.flatnonzero(index)
        if index.ndim != 1 or index.dtype.kind not in "iu" or np.any((index < 0) | (index >= self.n_link)):
            got = np.array2string(index, threshold=8)
            raise InputError(
                "links to take",
                f"indices from 0 to {self.n_link - 1}, or a mask of {self.n_link}",
                got,
                "Name links that exist",
            )
        chosen = {
            name: jnp.asarray(getattr(self, name))[index]
            for name, dims in DIMENSIONS.items()
            if dims[0] == "link" and getattr(self, name) is not None
        }
        return eqx.tree_at(
            lambda paths: [getattr(paths, name) for name in chosen], self, list(chosen.values())
        )


DIMENSIONS: Final[dict[str, tuple[str, ...]]] = {
    "delay": ("link", "path"),
    "carrier_phasor": ("link", "path"),
    "departure": ("link", "path", "xyz"),
    "arrival": ("link", "path", "xyz"),
    "mask": ("link", "path"),
    "interaction": ("link", "path", "depth"),
    "object": ("link", "path", "depth"),
    "vertex": ("link", "path", "depth", "xyz"),
    "normal": ("link", "path", "depth", "xyz"),
    "length": ("link", "path"),
    "tx_field": ("link", "path", "xyz"),
    "rx_field": ("link", "path", "xyz"),
    "rx_position": ("link", "xyz"),
    "tx_position": ("link", "xyz"),
    "object_material": ("object",),
    "permittivity": ("object",),
    "conductivity": ("object",),
    "thickness": ("object",),
    "scattering": ("object",),
    "object_center": ("object", "xyz"),
    "beyond": ("link", "path"),
}
"""The axes of every array of a `PathSet`."""

_REMEDY: Final = "Trace the scene again, or correct the array"


def path_set_among(data: Mapping[str, Any]) -> PathSet | None:
    """The path set among a model's arguments, whatever it is called there; None where there is none."""
    return next((value for value in data.values() if isinstance(value, PathSet)), None)


def validate(paths: PathSet) -> PathSet:
    """Check that a path set is whole, and give it back.

    Args:
        paths: a path set with concrete arrays.

    Raises:
        InputError: an array has another shape, holds NaN or infinity, an index out of range, an unknown
            code of interaction, a direction that is not of unit length, or a delay, length, carrier phasor and ends that
            contradict one another.
    """
    _check_shapes(paths)
    for name in DIMENSIONS:
        value = getattr(paths, name)
        if value is not None and not np.all(np.isfinite(np.asarray(value))):
            raise InputError(
                f"paths.{name}", "finite values (missing paths through the mask)", "NaN or inf", _REMEDY
            )
    codes = set(np.unique(np.asarray(paths.interaction)).tolist())
    if not codes <= set(INTERACTIONS):
        expected = ", ".join(f"{code} ({name})" for code, name in INTERACTIONS.items())
        raise InputError("paths.interaction", expected, str(sorted(codes - set(INTERACTIONS))), _REMEDY)
    _check_range("object", paths.object, paths.n_object)
    _check_range("object_material", paths.object_material, paths.n_material)
    if paths.beyond is not None:
        _check_range("beyond", paths.beyond, len(paths.beyond_names) + 1)
    if not paths.frequency > 0:
        raise InputError("paths.frequency", "a positive carrier in Hz", repr(paths.frequency), _REMEDY)
    _check_physics(paths)
    return paths


def _check_shapes(paths: PathSet) -> None:
    size = {"link": paths.n_link, "path": paths.n_path, "depth": paths.depth, "xyz": 3}
    size["object"] = len(paths.object_names)
    for name, dims in DIMENSIONS.items():
        value = getattr(paths, name)
        expected = tuple(size[dim] for dim in dims)
        if value is not None and np.shape(value) != expected:
            named = ", ".join(dims)
            raise InputError(f"paths.{name}", f"shape ({named}) = {expected}", str(np.shape(value)), _REMEDY)


def _check_range(name: str, value: Array, count: int) -> None:
    index = np.asarray(value)
    if index.size and (index.min() < 0 or index.max() >= count):
        got = f"{index.min()} to {index.max()}"
        raise InputError(f"paths.{name}", f"indices from 0 to {count - 1}", got, _REMEDY)


def _check_physics(paths: PathSet) -> None:
    mask = np.asarray(paths.mask)
    for name in ("departure", "arrival"):
        norm = np.linalg.norm(np.asarray(getattr(paths, name)), axis=-1)[mask]
        if norm.size and np.max(np.abs(norm - 1)) > 1e-4:
            got = f"lengths from {norm.min():.6g} to {norm.max():.6g}"
            raise InputError(f"paths.{name}", "unit vectors", got, _REMEDY)
    for name in ("delay", "length"):
        value = np.asarray(getattr(paths, name))[mask]
        if value.size and value.min() <= 0:
            raise InputError(f"paths.{name}", "positive values", f"{value.min():.6g}", _REMEDY)
    _check_lengths(paths, mask)


def _check_lengths(paths: PathSet, mask: np.ndarray) -> None:
    """Refuse delays, lengths, carrier phasors and ends that contradict one another, as where a unit is another one."""
    length, delay = np.asarray(paths.length, float), np.asarray(paths.delay, float)
    ends = np.asarray(paths.rx_position) - np.asarray(paths.tx_position)
    straight = np.broadcast_to(np.linalg.norm(ends, axis=-1)[:, None], mask.shape)
    travelled = delay * speed_of_light
    turned = np.exp(-2j * np.pi * np.mod(paths.frequency * delay, 1.0))
    # delays in single precision keep a millionth of the turns
    allowed = _TURNED + 2e-6 * np.pi * paths.frequency * delay
    for name, wrong, expected, got in (
        (
            "delay",
            np.abs(travelled - length) > _OFF * length,
            "s, the path's length over the speed of light",
            delay,
        ),
        (
            "length",
            length < straight * (1 - _OFF),
            "m, no less than from end to end in a straight line",
            length,
        ),
        (
            "carrier_phasor",
            np.abs(turned - np.asarray(paths.carrier_phasor)) > allowed,
            "exp(-2j pi f tau) of the path's delay and the carrier",
            paths.carrier_phasor,
        ),
    ):
        if np.any(wrong & mask):
            link, path = map(int, np.argwhere(wrong & mask)[0])
            value = f"{np.asarray(got)[link, path]:.4g} for path {path} of link {link} ({length[link, path]:.4g} m long)"
            raise InputError(
                f"paths.{name}", expected, value, "Check units and links, and make it of them again"
            )
