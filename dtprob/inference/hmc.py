"""Hamiltonian Monte Carlo with trajectories of lengths that every chain shares.

Where chains run side by side in one program, those of the No-U-Turn sampler wait for the longest trajectory among
them, and most of the work is thrown away. Here the number of leapfrog steps depends on nothing but the number of the
transition: low-discrepancy lengths, evenly from one step to the most, so that no direction of the posterior is
traversed in whole periods for ever.

Source: Neal, MCMC using Hamiltonian dynamics (2011), on random lengths; Hoffman, Radul and Sountsov, An adaptive-MCMC
scheme for setting trajectory lengths in Hamiltonian Monte Carlo (2021), on lengths that chains share.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
from blackjax.mcmc import hmc
from jaxtyping import Array, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.inference.blackjax_kernel import BlackJAXKernel
from dtprob.inference.hamiltonian import AbstractHamiltonian

_GOLDEN = 2_654_435_769  # 2^32 over the golden ratio
_MOST = 1 << 16


@dataclass(frozen=True)
class SharedLength:
    """A trajectory of 1 to `most` leapfrog steps; see `dtprob.inference.blackjax_kernel.Trajectory`."""

    most: int

    def steps(self, index: Array) -> Array:
        """Leapfrog steps of the transition of this number."""
        fraction = (jnp.asarray(index).astype(jnp.uint32) * jnp.uint32(_GOLDEN)) >> 16
        return 1 + ((fraction * self.most) >> 16).astype(int)

    def __call__(  # noqa: PLR0917
        self,
        key: PRNGKeyArray,
        chain: Any,
        density: Callable[[Array], Array],
        step_size: Array,
        inverse_mass: Array,
        index: Array,
    ) -> tuple[Any, Any, Array]:
        """One transition."""
        steps = self.steps(index)
        transition: Callable[..., tuple[Any, Any]] = hmc.build_kernel()
        moved, info = transition(key, chain, density, step_size, inverse_mass, steps)
        return moved, info, jnp.ceil(jnp.log2(steps + 1.0)).astype(int)


@dataclass(frozen=True)
class HMC(AbstractHamiltonian):
    """Hamiltonian Monte Carlo of BlackJAX with shared lengths, exact in the limit of many draws.

    For many chains in one program: `fit_each`, or `chain_method = "vectorized"` on a GPU. One chain alone is better
    served by the No-U-Turn samplers, which find the length themselves.

    Attributes:
        leapfrog: steps of the longest trajectory, at most 65,536. The more the unknowns and the stronger their
            correlations, the more it takes.
    """

    name: ClassVar[str] = "hmc"
    least: ClassVar[Mapping[str, int]] = {"leapfrog": 1}

    leapfrog: int = 8

    def kernel(self, warmup: int) -> BlackJAXKernel:
        """BlackJAX's transition.

        Raises:
            InputError: more leapfrog steps than the lengths are counted in.
        """
        if self.leapfrog > _MOST:
            got, remedy = str(self.leapfrog), "Take another engine, such as nuts"
            raise InputError(f"leapfrog of engine {self.name}", f"at most {_MOST}", got, remedy)
        return BlackJAXKernel(SharedLength(self.leapfrog), warmup, self.target_accept, self.dense_mass)
