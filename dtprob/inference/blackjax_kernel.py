"""Kernels of BlackJAX: a trajectory, and an adaptation that learns the mass matrix from draws and gradients.

The diagonal is sqrt(var(draws) / var(gradients)), which minimises the Fisher divergence between the posterior and
the normal distribution that the metric stands for, and needs fewer draws than a variance; windows are short at first
and then grow. Source: Cabezas et al., BlackJAX: composable Bayesian inference in JAX (2024); Seyboldt et al.,
Preconditioning Hamiltonian Monte Carlo by minimizing Fisher divergence (2026), as in nutpie.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from blackjax.adaptation.low_rank_adaptation import build_growing_window_schedule
from blackjax.adaptation.metric_recipes import REGISTRY, MetricCore
from blackjax.adaptation.step_size import dual_averaging_adaptation
from blackjax.mcmc import hmc
from jaxtyping import Array, Float, PRNGKeyArray

from dtprob.inference.kernel import Place, Stats, lifted_log_density
from dtprob.inference.target import Target


class Trajectory(Protocol):
    """How a chain moves, and ends somewhere on the way; hashable."""

    def __call__(  # noqa: PLR0917
        self,
        key: PRNGKeyArray,
        chain: Any,
        density: Callable[[Array], Array],
        step_size: Array,
        inverse_mass: Array,
        index: Array,
    ) -> tuple[Any, Any, Array]:
        """The chain's new state and BlackJAX's facts of the transition, and the doublings of the trajectory."""
        ...


class ChainState(NamedTuple):
    """A chain's position and what has been adapted."""

    chain: Any  # blackjax.mcmc.hmc.HMCState, whose annotations are not those of arrays
    step_size: Array
    averaging: Any
    mass: Any


@dataclass(frozen=True)
class BlackJAXKernel:
    """BlackJAX's transition and adaptation; see `dtprob.inference.kernel.Kernel`.

    Attributes:
        trajectory: how a chain moves.
        warmup: steps in which it adapts.
        target_accept: acceptance rate that the step size is adapted to.
        dense_mass: adapt a full mass matrix.
    """

    trajectory: Trajectory
    warmup: int
    target_accept: float
    dense_mass: bool

    def init(self, target: Target, key: PRNGKeyArray, position: Array, place: Place) -> ChainState:
        """State of a chain that starts at a position."""
        del key
        one = jnp.ones((), position.dtype)
        averaging = dual_averaging_adaptation(self.target_accept)[0](one)
        chain = hmc.init(position, _density(target, place))
        state = ChainState(
            chain, one, averaging, self._metric(jnp.asarray(chain.logdensity_grad)).init(target.dimension)
        )
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), state)

    def step(
        self, target: Target, key: PRNGKeyArray, state: ChainState, index: Array, place: Place
    ) -> tuple[ChainState, Stats]:
        """One transition."""
        density = _density(target, place)
        inverse_mass = state.mass.inverse_mass_matrix
        moved, info, depth = self.trajectory(key, state.chain, density, state.step_size, inverse_mass, index)
        stats = Stats(
            moved.logdensity,
            info.is_divergent,
            info.energy,
            depth,
            info.acceptance_rate,
            state.step_size,
        )
        state = state._replace(chain=moved)
        if self.warmup == 0:
            return state, stats
        adapted = jax.lax.cond(
            index < self.warmup, self._adapt, lambda s, *_: s, state, info.acceptance_rate, index
        )
        return adapted, stats

    def position(self, state: ChainState) -> Float[Array, " dimension"]:
        """Where the chain is."""
        return state.chain.position

    def shift(self, state: ChainState, position: Array, log_density: Array, gradient: Array) -> ChainState:
        """The state at another position."""
        chain = state.chain
        return state._replace(
            chain=chain._replace(
                position=position,
                logdensity=chain.logdensity + log_density,
                logdensity_grad=chain.logdensity_grad + gradient,
            )
        )

    def _metric(self, slope: Array | None = None) -> MetricCore:
        """How the inverse mass matrix is learned; a diagonal one begins at one over the size of the slope."""
        if self.dense_mass:
            return REGISTRY["welford_dense"].build_core()
        if slope is None:
            return REGISTRY["fisher_diag"].build_core()
        size = jnp.abs(slope)
        scale = jnp.where(jnp.isfinite(size) & (size > 1.0), 1 / size, 1.0)
        return REGISTRY["fisher_diag"].build_core(initial_inverse_mass_matrix=scale)

    def _adapt(self, state: ChainState, acceptance_rate: Array, index: Array) -> ChainState:
        restart, update, average = dual_averaging_adaptation(self.target_accept)
        metric = self._metric()
        is_slow, ends_window = jnp.asarray(build_growing_window_schedule(self.warmup))[index]
        averaging = update(state.averaging, acceptance_rate)
        chain = state.chain
        mass = jax.lax.cond(
            is_slow == 1,
            lambda: metric.update(state.mass, chain.position, chain.logdensity_grad),
            lambda: state.mass,
        )

        def close() -> tuple[Any, Any]:
            return restart(average(averaging)), metric.final(mass)

        averaging, mass = jax.lax.cond(ends_window == 1, close, lambda: (averaging, mass))
        is_last = index == self.warmup - 1
        step_size = jnp.where(is_last, average(averaging), jnp.exp(averaging.log_step_size))
        return ChainState(state.chain, step_size, averaging, mass)


def _density(target: Target, place: Place) -> Callable[[Array], Array]:
    return lambda u: lifted_log_density(target, u, place)
