"""Continuous observations as functions of a standard normal variable, and means over such a variable between bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, ndtri

from dtprob.gap.observation.residuals import Parameters

type Map = Callable[[Parameters, Any], jax.Array]

_FAR: Final = 8.5
"""Beyond so many standard deviations nothing is counted that bounds do not force."""
_DEPTH: Final = 12.0
"""Beyond a bound in a tail the density is followed until it has fallen by exp(-_DEPTH)."""
_NODES: Final = 32


class NormalScore(NamedTuple):
    """Growing maps (parameters, values) -> normal score and (parameters, normal score) -> value of one family."""

    of_value: Map
    to_value: Map


NORMAL_SCORES: Final[Mapping[str, NormalScore]] = {
    "Normal": NormalScore(lambda p, v: (v - p["loc"]) / p["scale"], lambda p, z: p["loc"] + p["scale"] * z),
    "LogNormal": NormalScore(
        lambda p, v: (jnp.log(v) - p["loc"]) / p["scale"], lambda p, z: jnp.exp(p["loc"] + p["scale"] * z)
    ),
    "Logistic": NormalScore(
        lambda p, v: ndtri(jax.nn.sigmoid((v - p["loc"]) / p["scale"])),
        lambda p, z: p["loc"] + p["scale"] * (log_ndtr(z) - log_ndtr(-z)),
    ),
    "Exponential": NormalScore(
        lambda p, v: -ndtri(jnp.exp(-p["rate"] * v)), lambda p, z: -log_ndtr(-z) / p["rate"]
    ),
    "Weibull": NormalScore(
        lambda p, v: -ndtri(jnp.exp(-((v / p["scale"]) ** p["concentration"]))),
        lambda p, z: p["scale"] * (-log_ndtr(-z)) ** (1 / p["concentration"]),
    ),
}
"""By the family; those that a floor, a ceiling or a mixture can be taken of."""


def between(low: jax.Array, high: jax.Array, nodes: int = _NODES) -> tuple[jax.Array, jax.Array]:
    """Standard normal variables between bounds (...): values (node, ...) and weights (node, ...) of sum 1.

    Bounds may be infinite or lie in a tail, where the density falls like an exponential.
    """
    above, below = jnp.maximum(low, 0.0), jnp.maximum(-high, 0.0)
    start = jnp.maximum(
        low, -_FAR - below - jnp.where(below > 1, _DEPTH / jnp.maximum(below, 1.0) - _FAR, 0.0)
    )
    stop = jnp.minimum(
        high, _FAR + above + jnp.where(above > 1, _DEPTH / jnp.maximum(above, 1.0) - _FAR, 0.0)
    )
    where, weight = (
        jnp.asarray(n).reshape(-1, *(1,) * low.ndim) for n in np.polynomial.legendre.leggauss(nodes)
    )
    z = start + (stop - start) * (1 + where) / 2
    log_density = -(z**2) / 2
    density = weight * jnp.exp(log_density - log_density.max(axis=0))
    return z, density / density.sum(axis=0)
