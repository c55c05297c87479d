"""The No-U-Turn sampler of BlackJAX, with Stan's windowed adaptation from BlackJAX's parts.

Source: Cabezas et al., BlackJAX: composable Bayesian inference in JAX (2024); Stan reference manual, HMC
algorithm parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from blackjax.adaptation.mass_matrix import mass_matrix_adaptation
from blackjax.adaptation.staged_adaptation import build_schedule
from blackjax.adaptation.step_size import dual_averaging_adaptation
from blackjax.mcmc import nuts
from jaxtyping import Array, Float, PRNGKeyArray

from dtprob.inference.chains import ChainMethod
from dtprob.inference.engine import DEFAULT, AbstractEngine, Answer, RunOptions
from dtprob.inference.kernel import Place, Stats, lifted_log_density
from dtprob.inference.posterior import Posterior
from dtprob.inference.run import Schedule, run_chains
from dtprob.inference.target import Target
from dtprob.models.declaration import Model


class ChainState(NamedTuple):
    """A chain's position and what has been adapted."""

    chain: Any  # blackjax.mcmc.hmc.HMCState, whose annotations are not those of arrays
    step_size: Array
    averaging: Any
    mass: Any


@dataclass(frozen=True)
class BlackJAXKernel:
    """BlackJAX's transition and adaptation; see `dtprob.inference.kernel.Kernel`."""

    warmup: int
    target_accept: float
    max_tree_depth: int
    dense_mass: bool

    def init(self, target: Target, key: PRNGKeyArray, position: Array, place: Place) -> ChainState:
        """State of a chain that starts at a position."""
        del key
        one = jnp.ones((), position.dtype)
        averaging = dual_averaging_adaptation(self.target_accept)[0](one)
        mass = mass_matrix_adaptation(not self.dense_mass)[0](target.dimension)
        state = ChainState(nuts.init(position, _density(target, place)), one, averaging, mass)
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), state)

    def step(
        self, target: Target, key: PRNGKeyArray, state: ChainState, index: Array, place: Place
    ) -> tuple[ChainState, Stats]:
        """One transition."""
        transition: Callable[..., tuple[Any, Any]] = nuts.build_kernel()
        moved, info = transition(
            key,
            state.chain,
            _density(target, place),
            state.step_size,
            state.mass.inverse_mass_matrix,
            self.max_tree_depth,
        )
        stats = Stats(
            info.is_divergent,
            info.energy,
            info.num_trajectory_expansions,
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

    def _adapt(self, state: ChainState, acceptance_rate: Array, index: Array) -> ChainState:
        restart, update, average = dual_averaging_adaptation(self.target_accept)
        _, learn, conclude = mass_matrix_adaptation(not self.dense_mass)
        is_slow, ends_window = jnp.asarray(build_schedule(self.warmup))[index]
        averaging = update(state.averaging, acceptance_rate)
        mass = jax.lax.cond(is_slow == 1, learn, lambda m, _: m, state.mass, state.chain.position)

        def close() -> tuple[Any, Any]:
            return restart(average(averaging)), conclude(mass)

        averaging, mass = jax.lax.cond(ends_window == 1, close, lambda: (averaging, mass))
        is_last = index == self.warmup - 1
        step_size = jnp.where(is_last, average(averaging), jnp.exp(averaging.log_step_size))
        return ChainState(state.chain, step_size, averaging, mass)


def _density(target: Target, place: Place) -> Callable[[Array], Array]:
    return lambda u: lifted_log_density(target, u, place)


@dataclass(frozen=True)
class BlackJAXNUTS(AbstractEngine):
    """The No-U-Turn sampler of BlackJAX; the same settings and promises as `NUTS`.

    Attributes:
        draws: draws of each chain.
        warmup: steps of each chain before them, in which it adapts.
        chains: how many chains.
        target_accept: acceptance rate that the step size is adapted to.
        max_tree_depth: bound on the doublings of a trajectory.
        dense_mass: adapt a full mass matrix rather than a diagonal one.
        chain_method: "sequential" or "vectorized": chains one after the other, or side by side, which is
            faster on a GPU but makes the last bits of a draw depend on the number of chains.
        initial: constrained values that every chain starts from; sites without one start from the prior.
    """

    name: ClassVar[str] = "blackjax_nuts"
    answer: ClassVar[Answer] = "exact"

    draws: int = 1000
    warmup: int = 1000
    chains: int = 4
    target_accept: float = 0.8
    max_tree_depth: int = 10
    dense_mass: bool = False
    chain_method: ChainMethod = "sequential"
    initial: Mapping[str, Any] | None = None

    def __call__(
        self, key: jax.Array, model: Model, data: Mapping[str, Any], *, options: RunOptions = DEFAULT
    ) -> Posterior:
        """Infer; see `AbstractEngine`."""

        def kernel(warmup: int) -> BlackJAXKernel:
            return BlackJAXKernel(warmup, self.target_accept, self.max_tree_depth, self.dense_mass)

        schedule = Schedule(self.chains, self.warmup, self.draws, self.chain_method, self.initial)
        return run_chains(self, kernel, schedule, key, model=model, data=data, options=options)
