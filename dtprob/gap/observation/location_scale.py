"""Rows of location-scale families that are known by the slope of their log density.

With r = (y - loc) / scale and psi = -(log f)'(r) of the standard density f, the scores are psi / scale and
(r psi - 1) / scale (Lehmann and Casella, Theory of Point Estimation (1998), section 2.5).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpyro.distributions as dist

from dtprob.gap.observation import probabilities
from dtprob.gap.observation.likelihood import Likelihood
from dtprob.gap.observation.residuals import EULER, Parameters

_NEAR: Final = 0.9
"""Psi up to which it tells the value; it ends at 1."""


def _location_scale(
    make: Callable[..., Any],
    slope: Callable[[jax.Array], jax.Array],
    information: tuple[float, float, float],
    probability: Callable[[jax.Array, jax.Array], jax.Array],
) -> Likelihood:
    """The likelihood of a family.

    Args:
        make: the distribution from its location and scale.
        slope: psi of r.
        information: on the location, on the scale and on both, at unit scale.
        probability: of smaller values, from psi and r psi; a fit may have taken from each what it likes.
    """
    location, scale, common = information
    root, left = math.sqrt(location), math.sqrt(scale - common**2 / location)

    def residual(p: Parameters, value: jax.Array) -> jax.Array:
        r = (value - p["loc"]) / p["scale"]
        psi = slope(r)
        return jnp.stack([psi / root, (r * psi - 1.0 - common / location * psi) / left])

    def shift(p: Parameters, t: Parameters) -> jax.Array:
        first = t["loc"] * root + t["scale"] * common / root
        return jnp.stack([first, t["scale"] * left]) / p["scale"]

    def relocate(p: Parameters, step: jax.Array) -> Parameters:
        return {**p, "loc": p["loc"] + step * p["scale"] / root}

    def respread(p: Parameters, step: jax.Array) -> Parameters:
        factor = jnp.exp(step / left)
        loc = p["loc"] - common / location * p["scale"] * (factor - 1.0)
        return {**p, "loc": loc, "scale": p["scale"] * factor}

    def smaller(_: Parameters, rows: jax.Array) -> jax.Array:
        psi = rows[0] * root
        return probability(psi, rows[1] * left + 1.0 + common / location * psi)

    return Likelihood(
        make,
        ("loc", "scale"),
        residual,
        shift,
        located=1,
        relocate=relocate,
        respread=respread,
        probability=smaller,
    )


def _logistic(psi: jax.Array, size: jax.Array) -> jax.Array:
    """Near the location psi tells the value, far from it, where psi is 1 or -1, its product with the value."""
    near = 2 * jnp.arctanh(jnp.clip(psi, -_NEAR, _NEAR))
    far = jnp.sign(psi) * jnp.maximum(size, 0.0) / jnp.clip(jnp.abs(psi), _NEAR, 1.0)
    return jax.nn.sigmoid(jnp.where(jnp.abs(psi) < _NEAR, near, far))


def _gumbel(psi: jax.Array, size: jax.Array) -> jax.Array:
    """Psi tells all values but the largest, of which it is 1."""
    near, far = -jnp.log1p(-jnp.minimum(psi, _NEAR)), size / jnp.clip(psi, _NEAR, 1.0)
    return jnp.exp(-jnp.exp(-jnp.where(psi < _NEAR, near, far)))


LOGISTIC: Final = _location_scale(
    dist.Logistic, lambda r: jnp.tanh(r / 2), (1 / 3, (3 + math.pi**2) / 9, 0.0), _logistic
)
CAUCHY: Final = _location_scale(
    dist.Cauchy, lambda r: 2 * r / (1 + r**2), (0.5, 0.5, 0.0), partial(probabilities.of_slope, df=1.0)
)
GUMBEL: Final = _location_scale(
    dist.Gumbel, lambda r: -jnp.expm1(-r), (1.0, (1 - EULER) ** 2 + math.pi**2 / 6, EULER - 1), _gumbel
)
