"""Draws from von Mises distributions, with derivatives in direction and concentration.

NumPyro's sampler accepts and rejects in a loop and declares only the direction reparametrised: its draws do
not depend differentiably on the concentration, and reverse-mode differentiation stops at the loop. The
derivative is therefore taken implicitly (Figurnov, Mohamed and Mnih, Implicit reparameterization gradients,
2018): a draw z keeps its probability F(z; kappa) when kappa changes, so

    dz/dkappa = - (dF/dkappa) / f(z) = int_0^z (A(kappa) - cos t) exp(kappa (cos t - cos z)) dt,

A = I1 / I0. The integrand changes its sign once, at cos t = A, and its integral over half the circle is zero;
so it is taken from 0 to z before that point, and from z to pi after it, where nothing cancels.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.scipy.special import i0e, i1e
from jaxtyping import Array, Float, PRNGKeyArray

_SMALLEST, _LARGEST = 1e-8, 1e6
_REACH = 9.0  # standard deviations after which nothing is left of the integral
_NODES, _WEIGHTS = (np.asarray(part) for part in np.polynomial.legendre.leggauss(40))


def sample(
    key: PRNGKeyArray, direction: Float[Array, " *shape"], concentration: Float[Array, " *shape"], n: int
) -> Float[Array, " draw *shape"]:
    """`n` draws; above a concentration of a million a normal, which then differs by less than 1e-6.

    Args:
        key: typed JAX key.
        direction: mu, rad.
        concentration: kappa, zero or more.
        n: how many.

    Returns:
        angles in rad, unwrapped, differentiable once in direction and concentration.
    """
    kappa = jax.lax.stop_gradient(concentration)
    normal = jax.random.normal(key, (n, *kappa.shape)) / jnp.sqrt(jnp.maximum(kappa, _LARGEST))
    spread = dist.VonMises(0.0, jnp.clip(kappa, _SMALLEST, _LARGEST)).sample(key, (n,))
    return direction + _following(jnp.where(kappa > _LARGEST, normal, spread), concentration)


@jax.custom_jvp
def _following(angle: Float[Array, " draw *shape"], concentration: Float[Array, " *shape"]) -> Array:
    """The angles themselves, which move with the concentration they were drawn with."""
    del concentration
    return angle


@_following.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    angle, concentration = primals
    return angle, tangents[0] + concentration_slope(angle, concentration) * tangents[1]


def concentration_slope(
    angle: Float[Array, " *shape"], concentration: Float[Array, " *shape"]
) -> Float[Array, " *shape"]:
    """Derivative of a draw in its concentration, rad.

    Args:
        angle: the draw less its direction, rad in [-pi, pi].
        concentration: kappa.
    """
    kappa = concentration[..., None]
    mean = i1e(kappa) / i0e(kappa)
    size = jnp.abs(angle)[..., None]
    is_inside = jnp.cos(size) >= mean
    end = jnp.minimum(jnp.pi, size + _REACH / jnp.sqrt(jnp.maximum(kappa, _SMALLEST)))
    low, high = jnp.where(is_inside, 0.0, size), jnp.where(is_inside, size, end)
    half = 0.5 * (high - low)
    t = low + half * (1 + _NODES)
    exponent = -2 * kappa * jnp.sin(0.5 * (t + size)) * jnp.sin(0.5 * (t - size))
    terms = _WEIGHTS * jnp.abs(mean - jnp.cos(t)) * jnp.exp(exponent)
    exact = -jnp.sign(angle) * half[..., 0] * jnp.sum(terms, axis=-1)
    return jnp.where(
        concentration > _LARGEST, -0.5 * angle / jnp.maximum(concentration, _SMALLEST), exact
    ).astype(angle.dtype)
