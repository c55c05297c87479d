"""Rows of location-scale families that are known by the slope of their log density.

With r = (y - loc) / scale and psi = -(log f)'(r) of the standard density f, the scores are psi / scale and
(r psi - 1) / scale (Lehmann and Casella, Theory of Point Estimation (1998), section 2.5).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpyro.distributions as dist

from dtprob.gap.observation.likelihood import Likelihood
from dtprob.gap.observation.residuals import EULER, Parameters


def _location_scale(
    make: Callable[..., Any],
    slope: Callable[[jax.Array], jax.Array],
    location: float,
    scale: float,
    common: float = 0.0,
) -> Likelihood:
    """The likelihood of a family with these entries of its information at unit scale."""
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

    return Likelihood(
        make, ("loc", "scale"), residual, shift, located=1, relocate=relocate, respread=respread
    )


LOGISTIC: Final = _location_scale(dist.Logistic, lambda r: jnp.tanh(r / 2), 1 / 3, (3 + math.pi**2) / 9)
CAUCHY: Final = _location_scale(dist.Cauchy, lambda r: 2 * r / (1 + r**2), 0.5, 0.5)
GUMBEL: Final = _location_scale(
    dist.Gumbel, lambda r: -jnp.expm1(-r), 1.0, (1 - EULER) ** 2 + math.pi**2 / 6, EULER - 1
)
