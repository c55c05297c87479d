"""Phases counted in turns: the cosine and sine of 2 pi t, fast and exact to rounding.

Taking out whole turns is exact, where reducing a phase in radians is not, and the short polynomials below
vectorise where the general functions of a CPU do not (they are several times slower in double precision). Derivatives
are those of cosine and sine: to differentiate the polynomials takes several times as long.
"""

import math
from typing import Final

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Complex, Float

_TERMS: Final = {4: (5, 6), 8: (8, 9)}
"""Terms of the Taylor series of sine and cosine on [-pi/4, pi/4], by size of the number in bytes."""


@jax.custom_jvp
@jax.jit
def cosine_sine(turns: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Cosine and sine of 2 pi times the argument.

    Args:
        turns: phase in turns, of any size.
    """
    quarter = jnp.round(4.0 * turns)
    angle = (turns - 0.25 * quarter) * (2.0 * math.pi)
    square = angle * angle
    sine_terms, cosine_terms = _TERMS[max(turns.dtype.itemsize, 4)]
    sine = angle * _series(square, [(-1) ** i / math.factorial(2 * i + 1) for i in range(sine_terms)])
    cosine = _series(square, [(-1) ** i / math.factorial(2 * i) for i in range(cosine_terms)])
    quadrant = quarter - 4.0 * jnp.floor(0.25 * quarter)
    swapped = (quadrant == 1) | (quadrant == 3)
    c, s = jnp.where(swapped, sine, cosine), jnp.where(swapped, cosine, sine)
    return jnp.where((quadrant == 1) | (quadrant == 2), -c, c), jnp.where(quadrant >= 2, -s, s)


@cosine_sine.defjvp
def _turned(
    primals: tuple[jax.Array], tangents: tuple[jax.Array]
) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    cosine, sine = cosine_sine(*primals)
    change = (2.0 * math.pi) * tangents[0]
    return (cosine, sine), (-sine * change, cosine * change)


def phasor(turns: Float[Array, "*n"]) -> Complex[Array, "*n"]:
    """The complex number exp(j 2 pi turns).

    Args:
        turns: phase in turns.
    """
    return lax.complex(*cosine_sine(turns))


def _series(x: Float[Array, "*n"], factors: list[float]) -> Float[Array, "*n"]:
    total = jnp.full_like(x, factors[-1])
    for factor in reversed(factors[:-1]):
        total = total * x + factor
    return total
