"""Path sets from what another ray tracer tells of each path: its coefficient, delay, directions."""

from typing import Final, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy.constants import speed_of_light

from dtprob.errors import InputError
from dtprob.raytracing.carrier import check_carrier
from dtprob.raytracing.paths import PathSet, validate

_LONGEST: Final = 1e4
"""A link's shortest path is no longer than this many straight lines, or as many metres where that is more."""
_STRAIGHT: Final = 1e-3
"""Excess length, in m, below which a path is the straight line, and met no wall beside an end either."""
_ALONG: Final = 0.995
"""Least cosine of the angle between a straight path's direction and the line between the ends."""
MATERIAL: Final = "imported"
"""Name of the one object and its material, on which no gain depends."""


class ImportedPaths(NamedTuple):
    """Paths of links, padded; where `mask` is false the other arrays hold anything.

    Attributes:
        coefficient: complex amplitude at the carrier, the phase of the delay included: h(f_c) is their sum.
        delay: s.
        departure: unit vector of travel leaving the transmitter.
        arrival: unit vector of travel at the receiver.
        mask: which paths exist.
        rx_position: of each link, m.
        tx_position: of each link, m.
    """

    coefficient: Complex[np.ndarray, "link path"]
    delay: Float[np.ndarray, "link path"]
    departure: Float[np.ndarray, "link path 3"]
    arrival: Float[np.ndarray, "link path 3"]
    mask: Bool[np.ndarray, "link path"]
    rx_position: Float[np.ndarray, "link 3"]
    tx_position: Float[np.ndarray, "link 3"]


def path_set(imported: ImportedPaths, frequency: float, provenance: tuple[tuple[str, str], ...]) -> PathSet:
    """The path set whose gains are those of the other ray tracer, whatever the materials.

    Materials cannot be calibrated on it: how the walls made the gains is not known. Phases, positions, powers and
    everything else that acts on given gains can.

    Args:
        imported: what was read.
        frequency: carrier, Hz.
        provenance: where the paths come from.

    Raises:
        InputError: no path at all, a gain above 0 dB, a delay that is not positive or does not fit the places of the
            ends, a straight path whose directions do not, or such a carrier.
    """
    mask = imported.mask
    check_carrier("carrier of the imported paths", frequency)
    if not mask.any():
        raise InputError("imported paths", "a path or more", "none", "Export links that are reached")
    delay = np.where(mask, imported.delay, 0.0).astype(np.float64)
    if np.any(delay[mask] <= 0):
        got = f"{delay[mask].min():.3g} s"
        raise InputError(
            "delays of the imported paths", "positive values in s", got, "Export absolute delays"
        )
    length = np.where(mask, delay * speed_of_light, 1.0)
    _check_geometry(imported, length)
    carrier = np.exp(-2j * np.pi * np.mod(frequency * delay, 1.0))
    spreading = speed_of_light / frequency / (4 * np.pi * length)
    wanted = np.where(mask, imported.coefficient, 0) / carrier / spreading
    links, paths = mask.shape
    along_x = np.zeros((links, paths, 3))
    along_x[..., 0] = 1.0
    up, receiver = np.array([0.0, 0.0, 1.0]), imported.rx_position[:, None, None]
    return validate(
        PathSet(
            delay=jnp.asarray(delay),
            carrier_phasor=jnp.asarray(carrier),
            departure=jnp.asarray(np.where(mask[..., None], imported.departure, up)),
            arrival=jnp.asarray(np.where(mask[..., None], imported.arrival, up)),
            mask=jnp.asarray(mask),
            interaction=jnp.zeros((links, paths, 1), jnp.int32),
            object=jnp.zeros((links, paths, 1), jnp.int32),
            vertex=jnp.asarray(np.broadcast_to(receiver, (links, paths, 1, 3))),
            normal=jnp.asarray(np.broadcast_to(up, (links, paths, 1, 3))),
            length=jnp.asarray(length),
            tx_field=jnp.asarray(along_x),
            rx_field=jnp.asarray(along_x * np.conj(wanted)[..., None]),
            rx_position=jnp.asarray(imported.rx_position),
            tx_position=jnp.asarray(imported.tx_position),
            object_material=jnp.zeros(1, jnp.int32),
            permittivity=jnp.ones(1),
            conductivity=jnp.zeros(1),
            thickness=jnp.full(1, 0.1),
            frequency=frequency,
            object_names=(MATERIAL,),
            material_names=(MATERIAL,),
            provenance=provenance,
        )
    )


def _check_geometry(imported: ImportedPaths, length: Float[np.ndarray, "link path"]) -> None:
    """Refuse paths that cannot be between their ends, as where a unit or an axis is another one."""
    mask, ahead = imported.mask, imported.rx_position - imported.tx_position
    apart = np.linalg.norm(ahead, axis=1)
    strongest = np.abs(np.where(mask, imported.coefficient, 0)).max()
    if strongest > 1:
        got, remedy = f"{20 * np.log10(strongest):.3g} dB", "Give powers in dB of the power that was sent"
        raise InputError("gains of the imported paths", "0 dB or less", got, remedy)
    shortest = np.where(mask, length, np.inf).min(axis=1)
    longest = _LONGEST * np.maximum(apart, 1.0)
    wrong = np.flatnonzero((shortest < apart * (1 - 1e-2)) | (np.isfinite(shortest) & (shortest > longest)))
    if wrong.size:
        link = int(wrong[0])
        expected = (
            f"paths no shorter than the {apart[link]:.4g} m between the ends of link {link}, and of its order"
        )
        remedy = "Check the units of delays (s) and positions (m), and the axes of positions"
        raise InputError("delays of the imported paths", expected, f"{shortest[link]:.4g} m", remedy)
    straight = mask & (length < apart[:, None] + _STRAIGHT) & (apart[:, None] > 1.0)
    for name, direction in (("departure", imported.departure), ("arrival", imported.arrival)):
        along = np.sum(direction * ahead[:, None], axis=-1) / np.maximum(apart, 1.0)[:, None]
        off = np.argwhere(straight & (along < _ALONG))
        if len(off):
            link, path = map(int, off[0])
            got = f"{np.rad2deg(np.arccos(along[link, path])):.0f} deg from it for path {path} of link {link}"
            expected = "that of the straight line for a path as long as it"
            remedy = "Check the units of angles (deg) and where they count from"
            raise InputError(f"direction of {name} of the imported paths", expected, got, remedy)


def unit_vector(
    zenith_deg: Float[np.ndarray, "*n"], azimuth_deg: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n 3"]:
    """Direction of a zenith angle (from the z axis) and an azimuth (from the x axis towards y), in degrees."""
    theta, phi = np.deg2rad(zenith_deg), np.deg2rad(azimuth_deg)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
