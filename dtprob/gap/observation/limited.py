"""Readings with a floor or a ceiling, and readings that are only seen between bounds.

The score of a reading beyond a limit is the mean, there, of the rows of the distribution without it; of a reading that is
only seen between bounds it is that distribution's row less its mean between them (Cohen, Truncated and Censored Samples,
1991). Means are quadratures of 32 nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from jax.scipy.special import ndtr

from dtprob.gap.observation.likelihood import Likelihood
from dtprob.gap.observation.normal_scores import NORMAL_SCORES, NormalScore, between
from dtprob.gap.observation.residuals import Parameters
from dtprob.gap.observation.whitening import Scores, made_of, outer, own_of, shift_of, whitened


def _moments(
    base: Likelihood, score: NormalScore, p: Parameters, low: jax.Array, high: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mean value (*value), mean rows (row, *value) and their second moment (*value, row, row) between normal scores."""
    z, weight = between(low, high)
    values = score.to_value(p, z)
    rows = base.residual(p, values)
    second = jnp.einsum("m...,im...,jm...->...ij", weight, rows, rows)
    return (weight * values).sum(0), (weight * rows).sum(1), second


def _bounded_score(score: NormalScore, p: Parameters, bound: jax.Array) -> jax.Array:
    """Normal score of a bound, which may be infinite."""
    inside = score.of_value(p, jnp.where(jnp.isfinite(bound), bound, score.to_value(p, jnp.zeros(()))))
    return jnp.where(jnp.isfinite(bound), inside, bound)


def censored(base: Likelihood, family: str, *, left: bool) -> Likelihood:
    """Values of which those beyond a "limit" are only known to be there; "censored" is 1 of the data that are.

    What a reading tells on average is that of one with the "farthest" limit of all, whatever became of it: limits of
    readings that were not censored are not known, and scores whitened by their outcome would have no mean of zero.
    """
    score = NORMAL_SCORES[family]

    def parts(p: Parameters) -> tuple[jax.Array, Any, Any]:
        """Chance of being beyond the limit, and the moments beyond and within it."""
        own = own_of(base, p)
        limit = _bounded_score(score, own, p["limit"])
        far = jnp.full(limit.shape, jnp.inf)
        lower, upper = (_moments(base, score, own, *ends) for ends in ((-far, limit), (limit, far)))
        return (ndtr(limit), lower, upper) if left else (ndtr(-limit), upper, lower)

    def scores(p: Parameters, value: jax.Array) -> jax.Array:
        beyond = value <= p["limit"] if left else value >= p["limit"]
        inside = jnp.where(beyond, score.to_value(own_of(base, p), jnp.zeros(())), value)
        return jnp.where(beyond, parts(p)[1][1], base.residual(own_of(base, p), inside))

    def information(p: Parameters) -> jax.Array:
        chance, (_, mean, _), (_, _, second) = parts({**p, "limit": p["farthest"]})
        chance = chance[..., None, None]
        return (1 - chance) * second + chance * outer(mean, mean)

    def mean(p: Parameters) -> jax.Array:
        chance, _, within = parts(p)
        return (1 - chance) * within[0] + jnp.where(chance > 0, chance * p["limit"], 0.0)

    kind = _Floored if left else _Capped
    further = {"limit": 0, "farthest": 0, "censored": 0}
    made = made_of(base, lambda **p: kind(base.make(**own_of(base, p)), p), further, mean)
    return whitened(made, Scores(scores, information, shift_of(base)), base.relocate)


def _limited(kind: Any, clip: Callable[[Any, Any], jax.Array]) -> Any:
    """A class of censored distributions whose draws have their limit."""

    class Limited(kind):
        """From what is censored, and the parameters."""

        pytree_data_fields = ("limit",)

        def __init__(self, base_dist: Any, p: Parameters) -> None:
            self.limit = p["limit"]
            super().__init__(base_dist, p["censored"] > 0)

        def sample(self, key: jax.Array | None, sample_shape: tuple[int, ...] = ()) -> jax.Array:
            return clip(super().sample(key, sample_shape), self.limit)

    return Limited


_Floored: Final = _limited(dist.LeftCensoredDistribution, jnp.maximum)
_Capped: Final = _limited(dist.RightCensoredDistribution, jnp.minimum)
TRUNCATED: Final[Mapping[str, tuple[Any, tuple[str, ...]]]] = {
    "LeftTruncated": (dist.LeftTruncatedDistribution, ("low",)),
    "RightTruncated": (dist.RightTruncatedDistribution, ("high",)),
    "TwoSidedTruncated": (dist.TwoSidedTruncatedDistribution, ("low", "high")),
}
"""Kinds of distributions that are cut off, and the names of their bounds."""


def truncated(base: Likelihood, family: str, *, kind: str) -> Likelihood:
    """Values of which only those between bounds, "low", "high" or both, are ever seen."""
    score, (make, bounds) = NORMAL_SCORES[family], TRUNCATED[kind]

    def moments(p: Parameters) -> tuple[jax.Array, jax.Array, jax.Array]:
        own, shape = own_of(base, p), jnp.shape(p[bounds[0]])
        far = {"low": jnp.full(shape, -jnp.inf), "high": jnp.full(shape, jnp.inf)}
        ends = (_bounded_score(score, own, p[n] if n in bounds else far[n]) for n in ("low", "high"))
        return _moments(base, score, own, *ends)

    def scores(p: Parameters, value: jax.Array) -> jax.Array:
        return base.residual(own_of(base, p), value) - moments(p)[1]

    def information(p: Parameters) -> jax.Array:
        _, mean, second = moments(p)
        return second - outer(mean, mean)

    made = made_of(
        base,
        lambda **p: make(base.make(**own_of(base, p)), *(p[n] for n in bounds)),
        dict.fromkeys(bounds, 0),
        lambda p: moments(p)[0],
    )
    return whitened(made, Scores(scores, information, shift_of(base)), base.relocate)
