"""Reflection and transmission of a plane wave at a wall, in real arithmetic.

Complex numbers are pairs (real, imaginary) here: XLA runs them several times faster than complex types on a
CPU, and the square root can be written so that a small conductivity survives single precision.

Source: Recommendation ITU-R P.2040, "Effects of building materials and structures on radiowave propagation":
the Fresnel coefficients of an interface and the single-layer slab.
"""

from typing import Final, Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float
from scipy.constants import epsilon_0, speed_of_light

from dtprob.errors import unknown_name
from dtprob.raytracing.phasor import cosine_sine

Law = Literal["slab", "half_space"]
LAWS: Final[tuple[Law, ...]] = ("slab", "half_space")

type Pair = tuple[Float[Array, "*n"], Float[Array, "*n"]]


class Coefficients(NamedTuple):
    """Complex coefficients, as pairs, for the field across (te) and in (tm) the plane of incidence."""

    reflected_te: Pair
    reflected_tm: Pair
    transmitted_te: Pair
    transmitted_tm: Pair


def multiply(a: Pair, b: Pair) -> Pair:
    """The product of two complex numbers."""
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def divide(a: Pair, b: Pair) -> Pair:
    """The quotient of two complex numbers."""
    scale = 1.0 / (b[0] * b[0] + b[1] * b[1])
    return (a[0] * b[0] + a[1] * b[1]) * scale, (a[1] * b[0] - a[0] * b[1]) * scale


def lossy_square_root(real: Float[Array, "*n"], loss: Float[Array, "*n"]) -> Pair:
    """The square root of ``real - j loss`` with ``loss >= 0``, on the branch of a decaying wave.

    Neither part is a difference of near equals, so that d/d(loss) is right down to loss = 0.

    Args:
        real: real part.
        loss: negative of the imaginary part.
    """
    tiny = jnp.asarray(jnp.finfo(real.dtype).tiny, real.dtype) ** 0.5
    magnitude = jnp.sqrt(real * real + loss * loss + tiny * tiny)
    major = jnp.sqrt(0.5 * (magnitude + jnp.abs(real)) + tiny)
    minor = 0.5 * loss / major
    positive = real >= 0
    return jnp.where(positive, major, minor), -jnp.where(positive, minor, major)


def coefficients(
    cosine: Float[Array, "*n"],
    permittivity: Float[Array, "*n"],
    conductivity: Float[Array, "*n"],
    thickness: Float[Array, "*n"],
    *,
    frequency: float,
    law: Law,
) -> Coefficients:
    """Coefficients of a slab in air, or of the half-space.

    With u = cos - b, v = cos + b, where b = a for TE and a/eta for TM and a = sqrt(eta - sin^2), an interface
    reflects u/v, and with e = exp(-j 2 pi d a / lambda) a slab reflects u v (1 - e^2) / (v^2 - u^2 e^2) and
    transmits (v^2 - u^2) e / (v^2 - u^2 e^2): all internal reflections summed. The half-space law has none:
    it reflects u/v and transmits (1 - u^2/v^2) e, one pass through a wall of that thickness.

    Args:
        cosine: of the angle of incidence, in [0, 1]; below 1e-4 (grazing) it counts as 1e-4.
        permittivity: relative permittivity.
        conductivity: S/m, not negative.
        thickness: m.
        frequency: Hz.
        law: "slab" or "half_space".

    Raises:
        InputError: there is no such law.
    """
    if law not in LAWS:
        raise unknown_name("law of a wall", law, LAWS, "law")
    loss = conductivity / (2 * jnp.pi * frequency * epsilon_0)
    eta = permittivity, -loss
    cosine = jnp.maximum(cosine, 1e-4)
    root = lossy_square_root((permittivity - 1.0) + cosine * cosine, loss)
    once = _one_pass(root, thickness * (frequency / speed_of_light))
    # (cos - a)(cos + a) = 1 - eta, free of cancellation
    te = _wall(cosine, root, (1.0 - permittivity, loss), once, law)
    over_eta = divide(root, eta)
    squared = multiply(over_eta, over_eta)
    tm = _wall(cosine, over_eta, (cosine * cosine - squared[0], -squared[1]), once, law)
    return Coefficients(te[0], tm[0], te[1], tm[1])


def _one_pass(root: Pair, turns: Float[Array, "*n"]) -> Pair:
    """The wave after one pass through the wall, exp(-j 2 pi turns root)."""
    size = jnp.exp(2 * jnp.pi * turns * root[1])
    cosine, sine = cosine_sine(-turns * root[0])
    return size * cosine, size * sine


def _wall(cosine: Float[Array, "*n"], b: Pair, uv: Pair, once: Pair, law: Law) -> tuple[Pair, Pair]:
    """Reflection and transmission of one polarisation from u v, cos and b."""
    v = cosine + b[0], b[1]
    v2 = multiply(v, v)
    difference = 4 * cosine * b[0], 4 * cosine * b[1]  # v^2 - u^2
    if law == "half_space":
        return divide(uv, v2), divide(multiply(difference, once), v2)
    twice = multiply(once, once)
    rest = 1.0 - twice[0], -twice[1]
    bottom = multiply(v2, rest)
    inside = multiply(difference, twice)
    bottom = bottom[0] + inside[0], bottom[1] + inside[1]
    return divide(multiply(uv, rest), bottom), divide(multiply(difference, once), bottom)
