"""Distributions made of others: counts with more zeros, and mixtures.

The score of each is a function of the rows of what it is made of: with more zeros, that row times the chance that a zero
is one of its own; of a mixture, the rows of the parts times the chance of each (Louis, J. R. Stat. Soc. B 44 (1982)). Sums
over counts are closed, those over mixed values quadratures.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpyro.distributions as dist

from dtprob.gap.observation.likelihood import Likelihood, Move
from dtprob.gap.observation.normal_scores import NORMAL_SCORES, between
from dtprob.gap.observation.residuals import Parameters
from dtprob.gap.observation.whitening import Scores, made_of, outer, own_of, shift_of, whitened

_NODES: Final = 96
"""Of each part, since what tells parts apart may change within a fraction of a deviation."""


def zero_inflated(base: Likelihood, _: str) -> Likelihood:
    """Counts, some of which are zero whatever the base says; "gate" is the chance of that."""

    def log_chance(own: Parameters, value: jax.Array) -> jax.Array:
        return base.make(**own).log_prob(value) if base.density is None else base.density(own, value)

    def density(p: Parameters, value: jax.Array) -> jax.Array:
        is_zero = value <= 0
        some = jnp.log1p(-jnp.where(is_zero, 0.0, p["gate"])) + log_chance(own_of(base, p), value)
        return jnp.where(is_zero, jnp.log(jnp.where(is_zero, at_zero(p)[1], 1.0)), some)

    def at_zero(p: Parameters) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Chance that the base is zero, that anything is, and the base's rows there."""
        own, nothing = own_of(base, p), jnp.zeros(jnp.shape(p["gate"]))
        chance = jnp.exp(log_chance(own, nothing))
        return chance, p["gate"] + (1 - p["gate"]) * chance, base.residual(own, nothing)

    def scores(p: Parameters, value: jax.Array) -> jax.Array:
        chance, zero, rows = at_zero(p)
        left = (1 - p["gate"]) * chance / zero
        count = jnp.where(value > 0, base.residual(own_of(base, p), value), left * rows)
        gate = jnp.where(value > 0, -1 / (1 - p["gate"]), (1 - chance) / zero)
        return jnp.concatenate([count, gate[None]])

    def information(p: Parameters) -> jax.Array:
        chance, zero, rows = at_zero(p)
        seen = (1 - p["gate"]) * chance
        within = (seen**2 / zero - seen)[..., None, None] * outer(rows, rows)
        within = within + (1 - p["gate"])[..., None, None] * jnp.eye(len(rows))
        across = chance * rows * (1 + (1 - chance) * (1 - p["gate"]) / zero)
        gate = (1 - chance) ** 2 / zero + (1 - chance) / (1 - p["gate"])
        return _bordered(within, across, gate)

    def change(p: Parameters, t: Parameters) -> jax.Array:
        return jnp.concatenate([shift_of(base)(p, t), t["gate"][None]])

    made = made_of(
        base,
        lambda gate, **own: dist.ZeroInflatedDistribution(base.make(**own), gate=gate),
        {"gate": 0},
        lambda p: (1 - p["gate"]) * base.make(**own_of(base, p)).mean,
    )
    return replace(whitened(made, Scores(scores, information, change), base.relocate), density=density)


def _bordered(within: jax.Array, across: jax.Array, last: jax.Array) -> jax.Array:
    """A matrix (*value, n + 1, n + 1) of a block, a column (n, *value) beside it, and the last entry."""
    column = jnp.moveaxis(across, 0, -1)
    top = jnp.concatenate([within, column[..., None]], axis=-1)
    bottom = jnp.concatenate([column, last[..., None]], axis=-1)
    return jnp.concatenate([top, bottom[..., None, :]], axis=-2)


def mixture(base: Likelihood, family: str) -> Likelihood:
    """One of several parts, along a last axis of the parameters; "log_weight" is the logarithm of the chance of each.

    The first score is that of all parts' locations together, each by its own standard deviation.
    """
    score = NORMAL_SCORES[family]

    def told(rows: jax.Array, chance: jax.Array, weight: jax.Array) -> jax.Array:
        """Scores (score, *value) of rows (row, *value, part) where each part has a chance (*value, part)."""
        parts = jnp.moveaxis(rows * chance, -1, 1)
        flat = parts.at[0, 0].set(parts[0].sum(0)).reshape(-1, *parts.shape[2:])
        return jnp.concatenate([flat, jnp.moveaxis(chance - weight, -1, 0)[:-1]])

    def scores(p: Parameters, value: jax.Array) -> jax.Array:
        own = own_of(base, p)
        values = value[..., None]
        log = p["log_weight"] + base.make(**own).log_prob(values)
        return told(base.residual(own, values), jax.nn.softmax(log), jnp.exp(p["log_weight"]))

    def information(p: Parameters) -> jax.Array:
        own, shape = own_of(base, p), jnp.shape(p["log_weight"])
        far = jnp.full(shape, jnp.inf)
        z, weight = between(-far, far, _NODES)
        wide = {n: v[..., None, :] for n, v in p.items()}  # (*value, drawn part, part)

        def one(total: jax.Array, node: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
            rows = scores(wide, score.to_value(own, node[0]))
            share = node[1] * jnp.exp(p["log_weight"])
            return total + jnp.einsum("...m,i...m,j...m->...ij", share, rows, rows), None

        count = len(base.residual(own, score.to_value(own, z[0])))
        size = (count + 1) * shape[-1] - 1
        return jax.lax.scan(one, jnp.zeros((*shape[:-1], size, size)), (z, weight))[0]

    def change(p: Parameters, t: Parameters) -> jax.Array:
        moved = jnp.moveaxis(shift_of(base)(p, t), -1, 1)
        moved = moved.at[0, 1:].add(-moved[0, 0])
        weights = jnp.moveaxis(t["log_weight"], -1, 0)
        return jnp.concatenate([moved.reshape(-1, *moved.shape[2:]), weights[:-1] - weights[-1]])

    def make(log_weight: jax.Array, **own: jax.Array) -> Any:
        return dist.MixtureSameFamily(dist.Categorical(logits=log_weight), base.make(**own))

    relocate = base.relocate
    move: Move | None = None if relocate is None else lambda p, step: relocate(p, step[..., None])
    trailing = {**dict.fromkeys(base.parameters, 1), "log_weight": 1}
    made = made_of(base, make, trailing, lambda p: make(**p).mean)
    return whitened(made, Scores(scores, information, change), move)
