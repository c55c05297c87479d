"""Latent sites of a model as unconstrained values: draws of the prior, and what is given."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.effects.redrawn import DRAWN
from dtprob.gap.model.declared import Declared
from dtprob.gap.model.layout import transform_of
from dtprob.gap.model.quick import quick_jit
from dtprob.inference.posterior import Posterior, Sampler


@final
class Prior:
    """Where the latent sites of a model may lie, whatever effects are live.

    Args:
        declared: the model.
    """

    def __init__(self, declared: Declared) -> None:
        self._declared = declared

    def draws(self, key: jax.Array, n: int, arrays: Any) -> dict[str, np.ndarray]:
        """Unconstrained prior draws (n, size) of each latent site."""
        found = self._draw(jax.random.split(key, n), arrays)
        return {name: np.asarray(value).reshape(n, -1) for name, value in found.items()}

    @cached_property
    def _draw(self) -> Any:
        @quick_jit
        def draw(keys: jax.Array, arrays: Any) -> dict[str, Any]:
            def one(key: jax.Array) -> dict[str, Any]:
                trace = self._declared.trace(arrays, key)
                latent = self._declared.declaration.latent
                return {name: transform_of(trace[name]["fn"]).inv(trace[name]["value"]) for name in latent}

            return jax.lax.map(one, keys)

        return draw

    def unconstrained(self, values: Mapping[str, Any], arrays: Any) -> dict[str, jax.Array]:
        """Flat unconstrained values of the sites of which constrained ones are given."""
        trace = self._declared.trace(arrays, given=values)
        inverse = {name: transform_of(trace[name]["fn"]).inv for name in values}
        return {name: inverse[name](jnp.asarray(value)).reshape(-1) for name, value in values.items()}

    def reference_draws(
        self, reference: Sampler, names: list[str], n: int, arrays: Any
    ) -> dict[str, np.ndarray]:
        """Unconstrained draws (n, size) of those of some sites that a reference knows, no more than a posterior has."""
        if isinstance(reference, Posterior):
            n = min(n, max(reference.chains * reference.draws_per_chain, 2))
        draws = reference.sample(jax.random.key(0), n)
        called = {name: name if name in draws else name.removesuffix(DRAWN) for name in names}
        chosen = {name: jnp.asarray(draws[own]) for name, own in called.items() if own in draws}
        flat = jax.vmap(self.unconstrained, in_axes=(0, None))(chosen, arrays)
        return {name: np.asarray(value) for name, value in flat.items()}
