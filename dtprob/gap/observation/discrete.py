"""Scores of counts, outcomes and classes as whitened regression rows; the counterpart of `residuals` for what is discrete.

Where a parameter is at its end (a rate or a chance of 0, a chance of 1) the outcome is certain, and a row tells nothing.

A residual takes parameters and values, a shift parameters and a change of each; both give (component, *shape of the value).
"""

from __future__ import annotations

from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc, digamma, gammaln

from dtprob.gap.observation.residuals import Parameters

_FEW: Final = 16
"""Counts up to which a sum over counts is taken one by one."""
_NODES: Final = np.polynomial.legendre.leggauss(24)
_STEP: Final = 1e-3
"""Relative step of differences, since the incomplete beta function has no derivative in its parameters."""


def _over(value: jax.Array, size: jax.Array) -> jax.Array:
    """A value in units of a size, 0 where the size is 0."""
    return jnp.where(size > 0, value / jnp.where(size > 0, size, 1.0), 0.0)


def _root(square: jax.Array) -> jax.Array:
    """A root that is 0 at 0, with its slope."""
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def poisson_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a Poisson distribution."""
    return _over(value - p["rate"], _root(p["rate"]))[None]


def poisson_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a Poisson distribution."""
    return _over(t["rate"], _root(p["rate"]))[None]


def poisson_density(p: Parameters, value: jax.Array) -> jax.Array:
    """Log density of a Poisson distribution; its slope is -1 at a rate of 0 that nothing was counted at."""
    some = value > 0
    counted = value * jnp.log(jnp.where(some, p["rate"], 1.0))
    return jnp.where(some, counted, 0.0) - p["rate"] - gammaln(value + 1.0)


def counts_deviation(p: Parameters) -> jax.Array:
    """Standard deviation of a count whose rate is gamma distributed."""
    return jnp.sqrt(p["concentration"] * (1 + p["rate"])) / p["rate"]


def counts_spread(p: Parameters) -> jax.Array:
    """Root of the information on the concentration where the mean is held."""
    return _counts_spread(p["concentration"], p["concentration"] / p["rate"])


def counts_spread_about(p: Parameters) -> jax.Array:
    """The same root in closed form: right for small and for large means, at most 1.7 times as large between them.

    A unit of steps needs no more, and it is taken at each evaluation of the density of a field of steps.
    """
    c, mean = p["concentration"], p["concentration"] / p["rate"]
    grown = mean * (c + 1 / 3) / (c + 2 / 3)
    return mean / (c * jnp.sqrt(2 * (c + mean) * (c + 1 + grown)))


@jax.custom_jvp
def _counts_spread(concentration: jax.Array, mean: jax.Array) -> jax.Array:
    """Root of the information on the concentration c where the mean m is held.

    It is E[psi'(c) - psi'(c + Y)] - m / (c (c + m)), the expectation the sum over k of P(Y > k) / (c + k)^2. The first k
    are taken one by one, then those that Y surely exceeds together, then those around its mean by quadrature.
    """
    c, mean = concentration[..., None], mean[..., None]
    success, deviation = mean / (c + mean), jnp.sqrt(mean * (c + mean) / c)
    start = _FEW - 0.5
    low = jnp.maximum(start, mean * jnp.exp(-8 * deviation / mean))
    log_low, log_high = jnp.log(low), jnp.log(jnp.maximum(low, mean + 12 * deviation) + 0.5)
    many = jnp.exp(log_low + (log_high - log_low) * (1 + _NODES[0]) / 2)
    width = many * (log_high - log_low) * _NODES[1] / 2
    few = jnp.broadcast_to(jnp.arange(_FEW, dtype=c.dtype), (*many.shape[:-1], _FEW))
    at = jnp.concatenate([few, many], axis=-1)
    weight = jnp.concatenate([jnp.ones_like(few), width], axis=-1)
    beyond = betainc(at + 1, jnp.broadcast_to(c, at.shape), jnp.broadcast_to(success, at.shape))
    whole = jnp.sum(weight * beyond / (c + at) ** 2, axis=-1, keepdims=True)
    whole = whole + 1 / (c + start) - 1 / (c + low)
    information = jnp.maximum(whole - mean / (c * (c + mean)), jnp.finfo(whole.dtype).eps * whole)
    return jnp.sqrt(information)[..., 0]


@_counts_spread.defjvp
def _counts_spread_jvp(
    at: tuple[jax.Array, jax.Array], tangent: tuple[jax.Array, jax.Array]
) -> tuple[jax.Array, jax.Array]:
    concentration, mean = at
    by_concentration = _counts_spread(concentration * (1 + _STEP), mean)
    by_concentration -= _counts_spread(concentration * (1 - _STEP), mean)
    by_mean = _counts_spread(concentration, mean * (1 + _STEP)) - _counts_spread(
        concentration, mean * (1 - _STEP)
    )
    slope = by_concentration / concentration * tangent[0] + by_mean / mean * tangent[1]
    return _counts_spread(concentration, mean), slope / (2 * _STEP)


def counts_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a negative binomial distribution, a Poisson one whose rate is gamma distributed."""
    c, mean = p["concentration"], p["concentration"] / p["rate"]
    more = (value - mean) / (c + mean)
    spread = digamma(value + c) - digamma(c) - jnp.log1p(mean / c) - more
    return jnp.stack([(value - mean) / counts_deviation(p), spread / counts_spread(p)])


def counts_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a negative binomial distribution."""
    mean = (t["concentration"] - t["rate"] * p["concentration"] / p["rate"]) / p["rate"]
    return jnp.stack([mean / counts_deviation(p), t["concentration"] * counts_spread(p)])


def geometric_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a geometric distribution, of the failures before a success; they grow with the value."""
    return _over(value * p["probs"] - (1 - p["probs"]), _root(1 - p["probs"]))[None]


def geometric_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a geometric distribution."""
    return _over(-t["probs"] / p["probs"], _root(1 - p["probs"]))[None]


def geometric_density(p: Parameters, value: jax.Array) -> jax.Array:
    """Log density of a geometric distribution, that of no failures where success is certain."""
    failures = value * jnp.log1p(-jnp.where(value > 0, p["probs"], 0.0))
    return jnp.where(value > 0, failures, 0.0) + jnp.log(p["probs"])


def geometric_relocate(p: Parameters, step: jax.Array) -> Parameters:
    """Another expected number of failures."""
    odds = (1 - p["probs"]) / p["probs"] * jnp.exp(_over(step, _root(1 - p["probs"])))
    return {**p, "probs": 1 / (1 + odds)}


def bernoulli_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a Bernoulli or binomial distribution of logits; finite where the probability rounds to zero or one.

    Nothing was tried where a binomial's count is zero, and nothing is said.
    """
    n, half = p.get("total_count", jnp.ones(())), p["logits"] / 2
    yes = jnp.where(value > 0, value * jnp.exp(-half), 0.0)
    no = jnp.where(value < n, (n - value) * jnp.exp(half), 0.0)
    return ((yes - no) / jnp.sqrt(jnp.maximum(n, 1.0)))[None]


def logits_deviation(p: Parameters) -> jax.Array:
    """Standard deviation of the number of successes."""
    n = p.get("total_count", jnp.ones(()))
    return jnp.sqrt(n * jax.nn.sigmoid(p["logits"]) * jax.nn.sigmoid(-p["logits"]))


def bernoulli_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a Bernoulli or binomial distribution of logits."""
    deviation = logits_deviation(p)
    return jnp.where(deviation > 0, t["logits"] * deviation, 0.0)[None]


def probs_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """Rows of a Bernoulli or binomial distribution of probabilities."""
    n = p.get("total_count", jnp.ones(()))
    return _over(value - n * p["probs"], _root(jnp.maximum(n, 1.0) * p["probs"] * (1 - p["probs"])))[None]


def probs_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a Bernoulli or binomial distribution of probabilities."""
    n = p.get("total_count", jnp.ones(()))
    return (jnp.sqrt(n) * _over(t["probs"], _root(p["probs"] * (1 - p["probs"]))))[None]


def probs_density(p: Parameters, value: jax.Array) -> jax.Array:
    """Log density of a Bernoulli or binomial distribution; finite where a probability rounds to zero or one."""
    n, probs = p.get("total_count", jnp.ones(())), p["probs"]
    rounding = jnp.finfo(probs.dtype)
    yes = value * jnp.log(jnp.maximum(jnp.where(value > 0, probs, 1.0), rounding.tiny))
    no = (n - value) * jnp.log1p(-jnp.minimum(jnp.where(value < n, probs, 0.0), 1 - rounding.eps))
    return yes + no + gammaln(n + 1.0) - gammaln(value + 1.0) - gammaln(n - value + 1.0)


def probs_impossible(p: Parameters, value: jax.Array) -> jax.Array:
    """Whether a certain outcome was another one, to which `probs_density` gives a density all the same."""
    n = p.get("total_count", jnp.ones(()))
    return ((p["probs"] <= 0) & (value > 0)) | ((p["probs"] >= 1) & (value < n))


def _probability(p: Parameters) -> jax.Array:
    return p["probs"] if "probs" in p else jax.nn.softmax(p["logits"])


def categorical_residual(p: Parameters, value: jax.Array) -> jax.Array:
    """One row for each outcome; together they sum to zero along the roots of the probabilities."""
    probability = _probability(p)
    one_hot = jax.nn.one_hot(value, probability.shape[-1], dtype=probability.dtype)
    return jnp.moveaxis((one_hot - probability) / jnp.sqrt(jnp.maximum(probability, 1e-30)), -1, 0)


def categorical_shift(p: Parameters, t: Parameters) -> jax.Array:
    """Shift of the rows of a categorical distribution."""
    probability = _probability(p)
    if "logits" in t:
        mean = jnp.sum(probability * t["logits"], axis=-1, keepdims=True)
        return jnp.moveaxis(jnp.sqrt(probability) * (t["logits"] - mean), -1, 0)
    return jnp.moveaxis(_over(t["probs"], _root(probability)), -1, 0)
