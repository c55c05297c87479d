"""What clusters cost where a fit is right: noise that is larger in some of them, or another observation, is no gap."""

from __future__ import annotations

from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dtprob.gap.model.problem import Problem
from dtprob.gap.model.quick import Hoisted
from dtprob.gap.observation import whiten

_DRAWS: Final = 64
"""Data sets drawn at the fit."""


def expected_loss(problem: Problem, x: np.ndarray) -> Float[np.ndarray, " cluster"]:
    """Mean over data drawn at a point of minus the log likelihood of each cluster there, in nats.

    Args:
        problem: the model on its data.
        x: the point.
    """
    observed = problem.compiled.observations(x)

    def loss(key: jax.Array) -> dict[str, jax.Array]:
        keys = dict(zip(observed, jax.random.split(key, len(observed)), strict=True))
        return {n: -whiten.log_prob(o, whiten.sample(o, keys[n])) for n, o in observed.items()}

    def total(keys: jax.Array) -> Any:
        def add(i: Any, sums: Any) -> Any:
            return jax.tree.map(jnp.add, sums, loss(keys[i]))

        return jax.lax.fori_loop(1, _DRAWS, add, loss(keys[0]))

    sums = Hoisted(total, jax.jit)(jax.random.split(jax.random.key(0), _DRAWS))
    each = {n: np.asarray(sums[n]) / (_DRAWS * k) for n, k in problem.rows.components.items()}
    return problem.rows.of_entries(each).sum(1)
