"""The gain of traced paths and the channel they make, in pure JAX."""

from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Complex, Float
from scipy.constants import speed_of_light

from dtprob.errors import InputError
from dtprob.raytracing.paths import INTERACTIONS, NONE, REFRACTION, SPECULAR, PathSet
from dtprob.raytracing.phasor import phasor
from dtprob.raytracing.slab import Law, coefficients
from dtprob.raytracing.transport import Vector, carry, components, dot, factors, meet

SUPPORTED: Final = (NONE, SPECULAR, REFRACTION)
"""Codes of the interactions whose field is known here."""

_NAMES: Final = ("permittivity", "conductivity", "thickness")


def path_gain(
    paths: PathSet,
    permittivity: Float[Array, " object"],
    conductivity: Float[Array, " object"],
    *,
    thickness: Float[Array, " object"] | None = None,
    law: Law = "slab",
) -> Complex[Array, "link path"]:
    """Passband gain a_p of every path, without the phase of its delay; 0 where a path is missing.

    a = lambda / (4 pi L) conj(F_r)^T J_D ... J_1 F_t, for line of sight, specular reflection and refraction.

    Args:
        paths: from `trace` or `load`.
        permittivity: relative permittivity of each object.
        conductivity: S/m of each object.
        thickness: m of each object; as the scene has it when None.
        law: what a wall is: "slab", all internal reflections summed, or "half_space", none of them (see
            `dtprob.raytracing.slab.coefficients`).

    Raises:
        InputError: the paths hold an interaction whose field is not known, an array has another length than
            there are objects, or there is no such law.
    """
    chosen = paths.thickness if thickness is None else thickness
    values = [
        _per_object(paths, name, value)
        for name, value in zip(_NAMES, (permittivity, conductivity, chosen), strict=True)
    ]
    require_supported(paths)
    return _gain(paths, *values, law)


@partial(jax.jit, static_argnames="law")
def _gain(
    paths: PathSet,
    permittivity: Float[Array, " object"],
    conductivity: Float[Array, " object"],
    thickness: Float[Array, " object"],
    law: Law,
) -> Complex[Array, "link path"]:
    """`path_gain` of what has been checked, traced once for all that ask."""
    values = permittivity, conductivity, thickness
    code, index = (jnp.moveaxis(array, 2, 0) for array in (paths.interaction, paths.object))
    normal = components(jnp.moveaxis(paths.normal, 2, 0))
    walls = meet(components(paths.departure), normal, code == SPECULAR)
    found = coefficients(
        walls.cosine, *(value[index] for value in values), frequency=paths.frequency, law=law
    )
    through = factors(walls, found, code == REFRACTION, _kept(paths, permittivity)[index])
    start = components(jnp.real(paths.tx_field)), components(jnp.imag(paths.tx_field))
    return _receive(paths, *carry(*start, walls, through))


def require_supported(paths: PathSet) -> None:
    """Raise where the field of a path is not known; does nothing inside `jax.jit`, where codes are unknown.

    Raises:
        InputError: an interaction is neither specular reflection nor refraction.
    """
    if isinstance(paths.interaction, Tracer):
        return
    other = sorted(set(np.unique(np.asarray(paths.interaction)).tolist()) - set(SUPPORTED))
    if other:
        raise InputError(
            "interactions of the path set",
            "line of sight, specular reflection and refraction",
            ", ".join(INTERACTIONS.get(code, str(code)) for code in other),
            "Trace without them; what they add can enter the model as a discrepancy",
        )


def steering(
    positions: Float[Array, "antenna 3"],
    direction: Float[Array, "link path 3"],
    frequency: float,
    sign: float,
) -> Complex[Array, "link path antenna"]:
    """Phase of each element of an array against the array's centre: exp(sign j 2 pi f/c r.k).

    Args:
        positions: of the elements from the centre, m, in world axes.
        direction: unit vector of travel: `paths.departure` with sign +1 for a transmitting array,
            `paths.arrival` with sign -1 for a receiving one.
        frequency: Hz.
        sign: +1 or -1.
    """
    return phasor((sign * frequency / speed_of_light) * jnp.einsum("lpx,ax->lpa", direction, positions))


def frequency_response(
    paths: PathSet,
    subcarrier_frequency: Float[Array, " subcarrier"],
    delay: Float[Array, "link path"] | None = None,
) -> Complex[Array, "link path subcarrier"]:
    """exp(-j 2 pi (f_c + f_k) tau_p), the carrier's phase taken from `paths.carrier_phasor`.

    A changed delay turns the carrier by its difference to `paths.delay`, so that single precision keeps it.

    Args:
        paths: whose delays and carrier.
        subcarrier_frequency: f_k from the carrier, Hz.
        delay: s, when it differs from that of the paths.
    """
    moved = paths.delay if delay is None else delay
    turns = moved[..., None] * subcarrier_frequency
    if delay is not None:
        turns = turns + (paths.frequency * (delay - paths.delay))[..., None]
    return paths.carrier_phasor[..., None] * phasor(-turns)


def synthesize(
    gain: Complex[Array, "link path"],
    response: Complex[Array, "link path subcarrier"],
    rx_response: Complex[Array, "link path rx_antenna"] | None = None,
    tx_response: Complex[Array, "link path tx_antenna"] | None = None,
    snapshot: Complex[Array, "link snapshot path"] | None = None,
) -> Complex[Array, "link snapshot rx_antenna tx_antenna subcarrier"]:
    """Sum the paths: sum_p a_p snapshot_p rx_p tx_p response_p, as one product of matrices per link.

    Args:
        gain: a_p of each path, 0 where there is none.
        response: of each path over the subcarriers, from `frequency_response`.
        rx_response: of each receiving antenna to each path; one antenna at the centre when None.
        tx_response: of each transmitting antenna; one antenna at the centre when None.
        snapshot: factor of each path in each snapshot, such as a phase error or a Doppler shift; a single
            snapshot when None.
    """
    one = jnp.ones((*gain.shape, 1), gain.dtype)
    rx = one if rx_response is None else rx_response
    tx = one if tx_response is None else tx_response
    weight = gain[:, None, :] if snapshot is None else snapshot * gain[:, None, :]
    left = jnp.einsum("lsp,lpr,lpt->lsrtp", weight, rx, tx)
    product = jnp.matmul(left.reshape(left.shape[0], -1, left.shape[-1]), response)
    return product.reshape(*left.shape[:-1], response.shape[2])


def _per_object(paths: PathSet, name: str, value: Float[Array, " object"]) -> Float[Array, " object"]:
    array = jnp.asarray(value)
    if array.shape != (paths.n_object,):
        expected = f"a value for each of the {paths.n_object} objects, shape ({paths.n_object},)"
        raise InputError(
            name, expected, f"shape {array.shape}", "Spread values of materials with `paths.object_material`"
        )
    return array


def _kept(paths: PathSet, like: Float[Array, " object"]) -> Float[Array, " object"]:
    """What scattering leaves of a specular reflection at each object, sqrt(1 - S^2)."""
    return jnp.ones_like(like) if paths.scattering is None else jnp.sqrt(1.0 - paths.scattering**2)


def _receive(paths: PathSet, real: Vector, imaginary: Vector) -> Complex[Array, "link path"]:
    """The gain lambda / (4 pi L) conj(F_r)^T E."""
    f_real, f_imaginary = components(jnp.real(paths.rx_field)), components(jnp.imag(paths.rx_field))
    length = jnp.where(paths.mask, paths.length, 1.0)
    scale = paths.wavelength / (4 * jnp.pi) / length
    gain_real = dot(f_real, real) + dot(f_imaginary, imaginary)
    gain_imaginary = dot(f_real, imaginary) - dot(f_imaginary, real)
    found = (jnp.where(paths.mask, scale * part, 0.0) for part in (gain_real, gain_imaginary))
    return lax.complex(*found)
