"""Field vectors of single antenna elements in world axes, with the names and conventions of Sionna RT.

Sources: C. Balanis, Antenna Theory (1997), eqs. 4-26a and 4-84 (dipoles); 3GPP TR 38.901, table 7.3-1 (sector
element), eqs. 7.3-4 and 7.3-5 (polarisation by slant angle, model 2), eq. 7.1-4 (rotation).
"""

from collections.abc import Callable
from typing import Final

import jax.numpy as jnp
from jaxtyping import Array, Float

from dtprob.errors import unknown_name

SLANT: Final = {"V": 0.0, "H": 0.5 * jnp.pi}
"""Slant angle in rad of each named polarisation."""


def _iso(theta: Float[Array, "*n"], phi: Float[Array, "*n"]) -> Float[Array, "*n"]:  # noqa: ARG001 (isotropic)
    return jnp.ones_like(theta)


def _dipole(theta: Float[Array, "*n"], phi: Float[Array, "*n"]) -> Float[Array, "*n"]:  # noqa: ARG001 (a body of revolution)
    return jnp.sqrt(1.5) * jnp.abs(jnp.sin(theta))


def _half_wave_dipole(theta: Float[Array, "*n"], phi: Float[Array, "*n"]) -> Float[Array, "*n"]:  # noqa: ARG001 (a body of revolution)
    sine = jnp.sin(theta)
    safe = jnp.where(jnp.abs(sine) < 1e-5, 1.0, sine)
    return jnp.sqrt(1.643) * jnp.abs(jnp.cos(0.5 * jnp.pi * jnp.cos(theta)) / safe)


def _sector(theta: Float[Array, "*n"], phi: Float[Array, "*n"]) -> Float[Array, "*n"]:
    width = jnp.deg2rad(65.0)
    vertical = jnp.minimum(12.0 * ((theta - 0.5 * jnp.pi) / width) ** 2, 30.0)
    horizontal = jnp.minimum(12.0 * (phi / width) ** 2, 30.0)
    gain_db = 8.0 - jnp.minimum(vertical + horizontal, 30.0)
    return 10.0 ** (gain_db / 20.0)


PATTERNS: Final[dict[str, Callable[..., Float[Array, "*n"]]]] = {
    "iso": _iso,
    "dipole": _dipole,
    "hw_dipole": _half_wave_dipole,
    "tr38901": _sector,
}
"""Amplitude over zenith and azimuth angle, of each named pattern."""


def field_vector(
    direction: Float[Array, "*n 3"],
    *,
    pattern: str = "iso",
    polarization: str | float = "V",
    orientation: Float[Array, "*n 3"] | tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Float[Array, "*n 3"]:
    """Field vector of an element in a direction, in world axes.

    Args:
        direction: unit vector from the antenna: the departure for a transmitter, minus the arrival for a
            receiver.
        pattern: "iso", "dipole", "hw_dipole" or "tr38901".
        polarization: "V", "H", or a slant angle in rad.
        orientation: rotations about z, y and x in rad, shared or one for each direction.

    Raises:
        InputError: there is no such pattern or polarisation.
    """
    if pattern not in PATTERNS:
        raise unknown_name("antenna pattern", pattern, PATTERNS, "pattern")
    rotation = rotation_matrix(jnp.asarray(orientation, dtype=direction.dtype))
    x, y, z = jnp.moveaxis(jnp.einsum("...ji,...j->...i", rotation, direction), -1, 0)
    level = x * x + y * y
    at_pole = level < 1e-12
    rho = jnp.sqrt(jnp.where(at_pole, 1.0, level))
    cosine, sine = jnp.where(at_pole, 1.0, x / rho), jnp.where(at_pole, 0.0, y / rho)
    sine_theta = jnp.where(at_pole, 0.0, rho)
    theta = jnp.arctan2(sine_theta, z)
    amplitude = PATTERNS[pattern](theta, jnp.arctan2(sine, cosine))
    along_theta = jnp.stack([z * cosine, z * sine, -sine_theta], axis=-1)
    along_phi = jnp.stack([-sine, cosine, jnp.zeros_like(sine)], axis=-1)
    slant = slant_angle(polarization)
    local = amplitude[..., None] * (jnp.cos(slant) * along_theta + jnp.sin(slant) * along_phi)
    return jnp.einsum("...ij,...j->...i", rotation, local)


def slant_angle(polarization: str | float) -> float:
    """Slant angle in rad of a polarisation by name, or the angle itself.

    Raises:
        InputError: there is no such polarisation of a single element.
    """
    if not isinstance(polarization, str):
        return float(polarization)
    if polarization not in SLANT:
        raise unknown_name("polarization of a single element", polarization, SLANT, "polarization")
    return float(SLANT[polarization])


def rotation_matrix(orientation: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """The matrix that takes local to world axes (TR 38.901, eq. 7.1-4).

    Args:
        orientation: rotations about z, y and x in rad.
    """
    (sa, sb, sc), (ca, cb, cc) = (jnp.moveaxis(f(orientation), -1, 0) for f in (jnp.sin, jnp.cos))
    rows = [
        [ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc],
        [sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc],
        [-sb, cb * sc, cb * cc],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
