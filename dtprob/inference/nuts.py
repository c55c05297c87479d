"""The No-U-Turn sampler of NumPyro.

Source: Hoffman and Gelman, The No-U-Turn Sampler (2014); Phan, Pradhan and Jankowiak, Composable effects for
flexible and accelerated probabilistic programming in NumPyro (2019).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray
from numpyro.infer.hmc import HMCState, hmc

from dtprob.inference.hamiltonian import AbstractHamiltonian
from dtprob.inference.kernel import Place, Stats, lifted_log_density
from dtprob.inference.target import Target


@dataclass(frozen=True)
class NumPyroKernel:
    """NumPyro's transition; see `dtprob.inference.kernel.Kernel`."""

    warmup: int
    target_accept: float
    max_tree_depth: int
    dense_mass: bool

    def init(self, target: Target, key: PRNGKeyArray, position: Array, place: Place) -> HMCState:
        """State of a chain that starts at a position."""
        return _without_keys(self._functions(target)[0](position, place=place, key=key))

    def step(
        self, target: Target, key: PRNGKeyArray, state: HMCState, index: Array, place: Place
    ) -> tuple[HMCState, Stats]:
        """One transition; NumPyro counts the steps in its own state."""
        del index
        start, step = self._functions(target)
        jax.eval_shape(functools.partial(start, place=None, key=key), state.z)  # binds the warm-up's length
        moved: HMCState = step(state._replace(rng_key=key), model_args=(place,))
        depth = jnp.floor(jnp.log2(jnp.maximum(moved.num_steps, 1))).astype(int) + 1
        lp = -jnp.asarray(moved.potential_energy)
        stats = Stats(
            lp, moved.diverging, moved.energy, depth, moved.accept_prob, moved.adapt_state.step_size
        )
        return _without_keys(moved), stats

    def position(self, state: HMCState) -> Float[Array, " dimension"]:
        """Where the chain is."""
        return state.z

    def shift(self, state: HMCState, position: Array, log_density: Array, gradient: Array) -> HMCState:
        """The state at another position."""
        return state._replace(
            z=position,
            potential_energy=state.potential_energy - log_density,
            z_grad=state.z_grad - gradient,
        )

    def _functions(self, target: Target) -> tuple[Callable[..., HMCState], Callable[..., HMCState]]:
        def potential_for(place: Place | None) -> Callable[[Array], Array]:
            if place is None:  # where the value does not matter: nothing of the model is traced
                return jnp.sum
            return lambda u: -lifted_log_density(target, u, place)

        init, step = hmc(potential_fn_gen=potential_for, algo="NUTS")

        def start(position: Array, *, place: Place | None, key: PRNGKeyArray) -> HMCState:
            return init(
                position,
                num_warmup=self.warmup,
                dense_mass=self.dense_mass,
                target_accept_prob=self.target_accept,
                max_tree_depth=self.max_tree_depth,
                model_args=(place,),
                rng_key=key,
            )

        return start, step


def _without_keys(state: HMCState) -> HMCState:
    return state._replace(rng_key=None, adapt_state=state.adapt_state._replace(rng_key=None))


@dataclass(frozen=True)
class NUTS(AbstractHamiltonian):
    """The No-U-Turn sampler of NumPyro, exact in the limit of many draws.

    Attributes:
        max_tree_depth: bound on the doublings of a trajectory.
    """

    name: ClassVar[str] = "nuts"
    least: ClassVar[Mapping[str, int]] = {"max_tree_depth": 1}

    max_tree_depth: int = 10

    def kernel(self, warmup: int) -> NumPyroKernel:
        """NumPyro's transition."""
        return NumPyroKernel(warmup, self.target_accept, self.max_tree_depth, self.dense_mass)
