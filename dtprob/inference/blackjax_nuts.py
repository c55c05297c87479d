"""The No-U-Turn sampler of BlackJAX; for its adaptation see `dtprob.inference.blackjax_kernel`.

Source: Cabezas et al., BlackJAX: composable Bayesian inference in JAX (2024).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from blackjax.mcmc import nuts
from jaxtyping import Array, PRNGKeyArray

from dtprob.inference.blackjax_kernel import BlackJAXKernel
from dtprob.inference.hamiltonian import AbstractHamiltonian


@dataclass(frozen=True)
class NoUTurn:
    """A trajectory that doubles until it turns back; see `dtprob.inference.blackjax_kernel.Trajectory`."""

    max_tree_depth: int

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
        del index
        transition: Callable[..., tuple[Any, Any]] = nuts.build_kernel()
        moved, info = transition(key, chain, density, step_size, inverse_mass, self.max_tree_depth)
        return moved, info, info.num_trajectory_expansions


@dataclass(frozen=True)
class BlackJAXNUTS(AbstractHamiltonian):
    """The No-U-Turn sampler of BlackJAX; promises and settings are those of `nuts`."""

    name: ClassVar[str] = "blackjax_nuts"
    least: ClassVar[Mapping[str, int]] = {"max_tree_depth": 1}

    max_tree_depth: int = 10

    def kernel(self, warmup: int) -> BlackJAXKernel:
        """BlackJAX's transition."""
        return BlackJAXKernel(NoUTurn(self.max_tree_depth), warmup, self.target_accept, self.dense_mass)
