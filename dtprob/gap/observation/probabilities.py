"""How probable smaller values are than those of which rows are given, for each family of numbers that is not normal.

Of counts, half of what is as large counts as smaller, and counts between whole numbers are in between.
Rows that a fit was taken out of are those of no value exactly: each entry's are read as far as they tell one, the sign from
the first, sizes from where a row still grows. All take parameters and rows (component, *shape of the value).
"""

from __future__ import annotations

import math
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc, digamma, erf, gammainc, gammaincc
from jax.typing import ArrayLike
from scipy import stats

from dtprob.gap.observation.discrete import counts_deviation
from dtprob.gap.observation.residuals import (
    Parameters,
    beta_spread,
    student_information,
    von_mises_spread,
)

_LEAST: Final = 1e-12
"""Smallest rate or chance of which something is counted."""
_END: Final = 1e-12
"""Share of the farthest that a row may reach by which it has to fall short to tell a size."""
_FLOOR: Final = 0.1
"""Smallest share of the mean that a positive value is told by: a fit may take that much from the rows of smaller ones."""


def exponential(_: Parameters, rows: jax.Array) -> jax.Array:
    """Of an exponential distribution; of a Weibull one, whose first row is that of its power, too."""
    return -jnp.expm1(-jnp.maximum(1.0 + rows[0], _FLOOR))


def gamma(p: Parameters, rows: jax.Array) -> jax.Array:
    """Of a gamma distribution."""
    a = p["concentration"]
    return gammainc(a, a * jnp.maximum(1.0 + rows[0] / jnp.sqrt(a), _FLOOR))


def inverse_gamma(p: Parameters, rows: jax.Array) -> jax.Array:
    """Of an inverse gamma distribution, whose rows are those of one over the value."""
    return 1.0 - gamma(p, rows)


def half_normal(_: Parameters, rows: jax.Array) -> jax.Array:
    """Of a half-normal distribution."""
    square = 1.0 + math.sqrt(2.0) * rows[0]
    return erf(jnp.sqrt(jnp.maximum(square, _FLOOR**2) / 2.0))


def beta(p: Parameters, rows: jax.Array) -> jax.Array:
    """Of a beta distribution, by its log odds."""
    a, b = p["concentration1"], p["concentration0"]
    odds = rows[0] * beta_spread(p)[2] + digamma(a) - digamma(b)
    return betainc(a, b, jax.nn.sigmoid(odds))


def student(p: Parameters, rows: jax.Array) -> jax.Array:
    """Of a Student t distribution."""
    v = p["df"]
    slope = rows[0] * jnp.sqrt((v + 1.0) / (v + 3.0))
    return of_slope(slope, 1.0 + student_information(v)[0] * rows[1], v)


def of_slope(slope: jax.Array, size: jax.Array, df: ArrayLike) -> jax.Array:
    """Of a Student t distribution, from the slope of its log density, (v + 1) r / (v + r^2), and that times the value r.

    Far values turn back in the slope; the product, which ends at v + 1, tells them.
    """
    v = jnp.asarray(df)
    r = slope * v / (v + 1.0 - jnp.clip(size, 0.0, (1.0 - _END) * (v + 1.0)))
    beyond = 0.5 * betainc(v / 2.0, 0.5, v / (v + r**2))
    return jnp.where(r > 0, 1.0 - beyond, beyond)


def laplace(_: Parameters, rows: jax.Array) -> jax.Array:
    """Of a Laplace distribution, whose first row is a sign."""
    beyond = 0.5 * jnp.exp(-jnp.maximum(rows[1] + 1.0, 0.0))
    return jnp.where(rows[0] > 0, 1.0 - beyond, beyond)


def von_mises(p: Parameters, rows: jax.Array) -> np.ndarray:
    """Of a von Mises distribution, from opposite its location on."""
    mean, ratio, spread = von_mises_spread(p)
    away = jnp.arctan2(rows[0] * ratio, rows[1] * spread + mean)
    return stats.vonmises.cdf(np.asarray(away), np.asarray(p["concentration"]))


def poisson(p: Parameters, rows: jax.Array) -> jax.Array:
    """Of a Poisson distribution."""
    rate = p["rate"]
    return gammaincc(jnp.maximum(rate + jnp.sqrt(rate) * rows[0], 0.0) + 0.5, jnp.maximum(rate, _LEAST))


def binomial(p: Parameters, rows: jax.Array) -> jax.Array:
    """Of a binomial distribution."""
    n = p["total_count"]
    probs = jnp.clip(p["probs"] if "probs" in p else jax.nn.sigmoid(p["logits"]), _LEAST, 1 - _LEAST)
    count = jnp.clip(n * probs + jnp.sqrt(n * probs * (1 - probs)) * rows[0], 0.0, n)
    return betainc(n - count + 0.5, count + 0.5, 1 - probs)


def gamma_poisson(p: Parameters, rows: jax.Array) -> jax.Array:
    """Of a negative binomial distribution."""
    mean = p["concentration"] / p["rate"]
    count = jnp.maximum(mean + counts_deviation(p) * rows[0], 0.0)
    return betainc(p["concentration"], count + 0.5, p["rate"] / (1 + p["rate"]))


def geometric(p: Parameters, rows: jax.Array) -> jax.Array:
    """Of a geometric distribution, of the failures before a success."""
    failure = jnp.clip(1 - p["probs"], _LEAST, 1 - _LEAST)
    count = jnp.maximum((rows[0] * jnp.sqrt(failure) + failure) / (1 - failure), 0.0)
    return 1 - failure ** (count + 0.5)
