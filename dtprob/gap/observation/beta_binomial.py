"""Successes among so many trials whose chance varies from count to count, as a beta variable does."""

from __future__ import annotations

from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.scipy.special import betaln, digamma, gammaln

from dtprob.gap.observation.likelihood import Likelihood
from dtprob.gap.observation.residuals import Parameters
from dtprob.gap.observation.whitening import Scores, whitened

_FEW: Final = 16
"""Counts at each end that are taken one by one; those between them are integrated over."""
_NODES: Final = np.polynomial.legendre.leggauss(48)
_REACH: Final = 12.0
"""Standard deviations around the mean over which counts are integrated over."""


def _parts(p: Parameters) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mean chance, total concentration, trials."""
    total = p["concentration1"] + p["concentration0"]
    return p["concentration1"] / total, total, p["total_count"]


def _scores(p: Parameters, value: jax.Array) -> jax.Array:
    """Scores of the log odds of the mean chance, and of the logarithm of the total concentration."""
    mean, total, n = _parts(p)
    a, b = p["concentration1"], p["concentration0"]
    both = digamma(total) - digamma(n + total)
    yes = digamma(value + a) - digamma(a) + both
    no = digamma(n - value + b) - digamma(b) + both
    return _of_trials(p, jnp.stack([mean * (1 - mean) * total * (yes - no), a * yes + b * no]))


def _of_trials(p: Parameters, rows: jax.Array) -> jax.Array:
    """Rows (score, *value) without the rounding that is left where nothing was tried."""
    return jnp.where(p["total_count"] > 0, rows, 0.0)


def _counts(p: Parameters) -> tuple[jax.Array, jax.Array]:
    """Counts (node, *value) and how many each stands for."""
    mean, total, n = _parts(p)
    deviation = jnp.sqrt(n * mean * (1 - mean) * (total + n) / (total + 1))
    first = jnp.arange(_FEW, dtype=mean.dtype).reshape(-1, *(1,) * mean.ndim) + 0 * n
    low = jnp.maximum(_FEW - 0.5, n * mean - _REACH * deviation)
    high = jnp.maximum(jnp.minimum(n - _FEW + 0.5, n * mean + _REACH * deviation), low)
    where, weight = (v.reshape(-1, *(1,) * mean.ndim) for v in _NODES)
    between = low + (high - low) * (1 + where) / 2
    last = n - first
    ones = (first <= n, (high - low) * weight / 2, last >= _FEW)
    counts = jnp.concatenate([jnp.minimum(first, n), between, jnp.maximum(last, 0.0)])
    return jnp.where(counts < n, counts, n), jnp.concatenate([jnp.asarray(w, mean.dtype) for w in ones])


def _information(p: Parameters) -> jax.Array:
    """Covariance (*value, 2, 2) of the scores."""
    _, _, n = _parts(p)
    k, weight = _counts(p)
    a, b = p["concentration1"], p["concentration0"]
    choices = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
    chance = weight * jnp.exp(choices + betaln(k + a, n - k + b) - betaln(a, b))
    rows = _scores(p, k)
    told = jnp.einsum("m...,im...,jm...->...ij", chance / chance.sum(0), rows, rows)
    return jnp.where(n[..., None, None] > 0, told, jnp.eye(2))


def _change(p: Parameters, t: Parameters) -> jax.Array:
    mean, total, _ = _parts(p)
    more = t["concentration1"] + t["concentration0"]
    return _of_trials(
        p, jnp.stack([(t["concentration1"] - mean * more) / (mean * (1 - mean) * total), more / total])
    )


def _to_odds(p: Parameters, step: jax.Array) -> Parameters:
    """Other log odds of the mean chance at the same total concentration."""
    mean, total, _ = _parts(p)
    moved = jax.nn.sigmoid(jnp.log(mean) - jnp.log1p(-mean) + step)
    return {**p, "concentration1": moved * total, "concentration0": (1 - moved) * total}


BETA_BINOMIAL: Final = whitened(
    Likelihood(
        lambda concentration1, concentration0, total_count: dist.BetaBinomial(
            concentration1, concentration0, jnp.asarray(total_count, int)
        ),
        ("concentration1", "concentration0", "total_count"),
        _scores,
        _change,
        located=1,
    ),
    Scores(_scores, _information, _change),
    _to_odds,
)
