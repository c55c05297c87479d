"""Angles for samplers: how a periodic density becomes one over the reals that nothing gets stuck in.

An angle z is lifted to a real u = z + 2 pi K with a random winding number K. The lifted density is
p(z) w(u - centre) with w(v) = F((v + pi) / s) - F((v - pi) / s), F the logistic distribution function: a
window of width 2 pi with soft walls. Over all windings w sums to one, so z keeps exactly its own density.
The walls make trajectories turn back where the density is flat, and keep the variance that a mass matrix
learns finite; the centre, put on the chain's mean direction early in warm-up, keeps the walls away from the
mass. Between trajectories K is drawn afresh given z, exactly: with e logistic, u = centre + e + wrap(u -
centre - e).
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, Scalar

from dtprob.inference.circular import wrap

_SOFTNESS = 0.5
_HALF = math.pi / _SOFTNESS


def log_window(offset: Float[Array, " angle"]) -> Scalar:
    """Sum of log w over angles.

    Args:
        offset: unwrapped angles from the centre, rad.
    """
    scaled = offset / _SOFTNESS
    walls = _log_cosh((_HALF + scaled) / 2) + _log_cosh((_HALF - scaled) / 2)
    return jnp.sum(_LOG_SINH - jnp.log(2.0) - walls, initial=0.0)


def redraw_winding(
    key: PRNGKeyArray, angle: Float[Array, " angle"], centre: Float[Array, " angle"]
) -> Float[Array, " angle"]:
    """The same angles with winding numbers drawn given them.

    Args:
        key: typed JAX key.
        angle: unwrapped angles, rad.
        centre: centres of their windows, rad.
    """
    shift = _SOFTNESS * jax.random.logistic(key, angle.shape, angle.dtype)
    return centre + shift + wrap(angle - centre - shift)


def recentred(angle: Float[Array, " angle"], centre: Float[Array, " angle"]) -> Float[Array, " angle"]:
    """The same angles, unwrapped to within half a turn of new centres, rad."""
    return centre + wrap(angle - centre)


def _log_cosh(x: Array) -> Array:
    return jnp.logaddexp(x, -x) - jnp.log(2.0)


_LOG_SINH = _HALF + math.log1p(-math.exp(-2 * _HALF)) - math.log(2.0)
