"""Which coordinates a fit moves, and the priors of effects that join the base model's."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.plausible import plausible_spread
from dtprob.gap.model.layout import Block
from dtprob.gap.model.problem import Problem

LOG_2PI: Final = float(np.log(2 * np.pi))
_FIRST: Final = 0.3
"""Share of the largest plausible standard deviation of a field that its fit starts from."""


@dataclass(frozen=True)
class Active:
    """Which coordinates a fit moves, and the priors that are not the base model's."""

    blocks: tuple[Block, ...]
    effects: tuple[Effect, ...]
    weights: np.ndarray
    spread: dict[str, float]

    @property
    def global_index(self) -> np.ndarray:
        """Positions of the global coordinates."""
        parts = [b.index[0] for b in self.blocks if not b.local]
        return np.concatenate(parts) if parts else np.zeros(0, int)

    @property
    def local_index(self) -> np.ndarray:
        """Positions of the local coordinates, (cluster, local)."""
        parts = [b.index for b in self.blocks if b.local]
        return np.concatenate(parts, axis=1) if parts else np.zeros((len(self.weights), 0), int)

    @property
    def own(self) -> Active:
        """The local coordinates alone, the global ones held."""
        return replace(self, blocks=tuple(b for b in self.blocks if b.local))


def activate(
    problem: Problem,
    effects: Sequence[str] = (),
    weights: np.ndarray | None = None,
    spread: Mapping[str, float] = MappingProxyType({}),
) -> Active:
    """The base model's nuisances and the named effects.

    Args:
        problem: in which the effects are live.
        effects: their names.
        weights: per cluster, one by default.
        spread: standard deviation of variance effects' fields by name; those not given get one to start from.
    """
    chosen = tuple(e for e in problem.live if e.name in effects)
    blocks = [b for b in problem.layout.blocks if b.owner is None or b.owner in effects]
    weights = np.ones(problem.n_cluster) if weights is None else weights
    fields = [e for e in chosen if e.kind == "variance"]
    return Active(
        tuple(blocks),
        chosen,
        weights,
        {e.name: spread.get(e.name, _FIRST * plausible_spread(e)) for e in fields},
    )


def means_among(problem: Problem, names: Collection[str]) -> list[str]:
    """Those of the named live effects that are no random fields."""
    return [e.name for e in problem.live if e.name in names and e.kind == "mean"]


def effect_prior(problem: Problem, active: Active, x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Log prior, its gradient and minus its curvature (diagonal) for the free effects' coordinates.

    Of a field of which clusters have their own entries, those of clusters that are left out do not count in the first.
    """
    total = 0.0
    gradient, curvature = np.zeros(problem.dimension), np.zeros(problem.dimension)
    for effect in active.effects:
        if effect.kind == "variance":
            sd, block = active.spread[effect.name], problem.field_of(effect)
            w = x[block.index]
            density = -0.5 * np.sum((w / sd) ** 2, axis=1) - w.shape[1] * (np.log(sd) + 0.5 * LOG_2PI)
            total += float(density @ (active.weights if block.local else np.ones(1)))
            gradient[block.index] = -w / sd**2
            curvature[block.index] = 1 / sd**2
        for parameter in effect.fitted:
            block = problem.layout[effect.site_name(parameter.name)]
            value = x[block.index[0]].reshape(parameter.shape)
            sd = parameter.scale * np.ones(parameter.shape)
            # the null may not count as support
            inside = np.maximum(value, parameter.null + 1e-9 * sd) if parameter.is_one_sided else value
            density, slope, bend = map(np.asarray, _log_prob(parameter.prior, inside))
            total += float(density)
            gradient[block.index[0]] = slope.reshape(-1)
            curvature[block.index[0]] = np.where(bend > 0, bend, 1 / sd.reshape(-1) ** 2)
    return total, gradient, curvature


@jax.jit
def _log_prob(prior: dist.Distribution, value: np.ndarray) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of all entries together, its slope, and minus its curvature along each; one program for each kind of distribution.

    Minus infinity where the prior does not allow a value, which its density does not tell.
    """

    def total(flat: jax.Array) -> jax.Array:
        return jnp.sum(prior.log_prob(flat.reshape(value.shape)))

    flat = jnp.asarray(value, float).reshape(-1)
    slope = jax.grad(total)
    support: Any = prior.support
    is_allowed = jnp.all(support(flat.reshape(value.shape)))
    density = jnp.where(is_allowed, total(flat), -jnp.inf)
    return density, slope(flat), -jnp.diagonal(jax.jacfwd(slope)(flat))


def basis(problem: Problem, active: Active) -> np.ndarray:
    """One direction per global coordinate, then one per local coordinate that moves it in all clusters at once."""
    n_global, n_local = len(active.global_index), active.local_index.shape[1]
    directions = np.zeros((n_global + n_local, problem.dimension))
    directions[np.arange(n_global), active.global_index] = 1.0
    for j in range(n_local):
        directions[n_global + j, active.local_index[:, j]] = 1.0
    return directions


def own_basis(problem: Problem, active: Active) -> np.ndarray:
    """Those of these directions that move local coordinates, (local, dimension)."""
    return basis(problem, active)[len(active.global_index) :]
