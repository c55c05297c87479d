"""Tables of probabilities whose prior concentration is not known: one for each table, weighed by its evidence.

With few data a fixed concentration decides how sure a Dirichlet table is of what it did not see: 0.01 takes what was
seen once for certain, 1/2 expects every outcome. The mixture learns from all rows of a table which it is.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.inference.posterior import Values
from dtprob.models.dirichlet import log_draws, log_marginal

GRID = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)


@final
@dataclass(frozen=True)
class LearnedConcentration:
    """The posterior of tables after counts, each under an unknown concentration; a sampler of their logarithms.

    Attributes:
        allowed: for each site, which outcomes can happen, (*row, outcome).
        counts: for each site, how often each happened, (*batch, *row, outcome); batches are posteriors of their own.
        grid: the concentrations that are equally likely before the data.

    Raises:
        InputError: concentrations that are not positive, or counts that do not fit or of what cannot happen.
    """

    allowed: Mapping[str, Bool[np.ndarray, "*row outcome"]]
    counts: Mapping[str, Float[np.ndarray, "*batch_row outcome"]]
    grid: tuple[float, ...] = GRID

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        if not self.grid or min(self.grid) <= 0:
            raise InputError("grid of concentrations", "positive numbers", str(self.grid), "Correct it")
        for name, mask in self.allowed.items():
            shape = np.shape(self.counts.get(name, ()))
            if shape[len(shape) - mask.ndim :] != mask.shape:
                remedy = "Count every entry of the table"
                raise InputError(f"counts of {name!r}", f"(..., {mask.shape})", str(shape), remedy)
            odd = np.argwhere(~((self.counts[name] == 0) | (mask & (np.asarray(self.counts[name]) > 0))))
            if len(odd):
                got = f"{self.counts[name][tuple(odd[0])]} at [{', '.join(map(str, odd[0]))}]"
                expected = "zero or more, and zero where an outcome cannot happen"
                raise InputError(f"counts of {name!r}", expected, got, "Correct them, or allow the outcome")

    def log_weights(self, site: str) -> Float[np.ndarray, "*batch grid"]:
        """Log-probability of each concentration of a table after the data."""
        mask, counts = self.allowed[site], self.counts[site]
        rows = tuple(range(counts.ndim - mask.ndim, counts.ndim - 1))
        evidence = [log_marginal(np.where(mask, a, 0.0), counts).sum(axis=rows) for a in self.grid]
        stacked = np.stack(evidence, axis=-1)
        return stacked - np.logaddexp.reduce(stacked, axis=-1, keepdims=True)

    def sample(self, key: PRNGKeyArray, n: int) -> Values:
        """`n` independent draws, {site: (n, *batch, *row, outcome)} of log-probabilities."""
        return {
            name: self._draw(jax.random.fold_in(key, i), name, n)
            for i, name in enumerate(sorted(self.allowed))
        }

    def _draw(self, key: PRNGKeyArray, site: str, n: int) -> np.ndarray:
        first, second = jax.random.split(key)
        mask, counts, weight = self.allowed[site], self.counts[site], self.log_weights(site)
        chosen = jax.random.categorical(first, jnp.asarray(weight), shape=(n, *weight.shape[:-1]))
        own = np.asarray(self.grid)[np.asarray(chosen)].reshape(*chosen.shape, *(1,) * mask.ndim)
        concentration = np.where(mask, own + counts, 0.0)
        allowed = np.broadcast_to(mask, concentration.shape)
        return np.asarray(log_draws(second, jnp.asarray(concentration), allowed))
