"""What the samplers by Hamiltonian trajectories have in common: their settings, and the run."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, get_args

import jax

from dtprob.errors import InputError
from dtprob.inference.chains import ChainMethod
from dtprob.inference.engine import (
    DEFAULT,
    AbstractEngine,
    Answer,
    RunOptions,
    check_choice,
    check_counts,
    check_initial,
)
from dtprob.inference.enough import Enough
from dtprob.inference.kernel import Kernel
from dtprob.inference.posterior import Posterior
from dtprob.inference.run import Schedule, run_chains
from dtprob.models.arguments import Model


@dataclass(frozen=True)
class AbstractHamiltonian(AbstractEngine):
    """A sampler by Hamiltonian trajectories with windowed adaptation.

    A draw depends on the key, its chain and its place in the chain; not on chunks, interruptions, or how many
    chains or draws there are. Angles do not get stuck at +-pi; see `dtprob.inference.winding`.

    Attributes:
        draws: draws of each chain.
        warmup: steps of each chain before them, in which it adapts.
        chains: how many chains.
        target_accept: acceptance rate that the step size is adapted to.
        dense_mass: adapt a full mass matrix rather than a diagonal one.
        chain_method: "parallel" or "vectorized": each chain by itself, on as many cores as there are, or all in one
            program, which is faster on a GPU but makes the last bits of a draw depend on the number of chains.
        initial: constrained values that every chain starts from; sites without one start from the prior.
        enough_ess: stop once every coordinate has this effective sample size and no r-hat above `enough_rhat`;
            0 makes all draws.
        enough_rhat: see `enough_ess`.
        least: the least that the settings of a trajectory's length can be.
    """

    answer: ClassVar[Answer] = "exact"
    least: ClassVar[Mapping[str, int]]

    draws: int = 1000
    warmup: int = 1000
    chains: int = 4
    target_accept: float = 0.8
    dense_mass: bool = False
    chain_method: ChainMethod = "parallel"
    initial: Mapping[str, Any] | None = None
    enough_ess: int = 0
    enough_rhat: float = 1.01

    @abc.abstractmethod
    def kernel(self, warmup: int) -> Kernel:
        """The transition, which adapts itself in the first `warmup` steps."""

    def __post_init__(self) -> None:
        """Refuse settings that cannot work."""
        if not 0 < self.target_accept < 1:
            what, got = f"target_accept of engine {self.name}", f"{self.target_accept:g}"
            raise InputError(what, "a rate between 0 and 1", got, "Give a rate, such as 0.8")
        check_counts(self, {"chains": 1, "warmup": 0, "draws": 1, **self.least})
        check_choice(self, "chain_method", get_args(ChainMethod.__value__))
        check_initial(self.initial)

    def schedule(self) -> Schedule:
        """How long a run is."""
        enough = Enough(self.enough_ess, self.enough_rhat)
        return Schedule(self.chains, self.warmup, self.draws, self.chain_method, self.initial, enough)

    def __call__(
        self, key: jax.Array, model: Model, data: Mapping[str, Any], *, options: RunOptions = DEFAULT
    ) -> Posterior:
        """Infer; see `AbstractEngine`."""
        return run_chains(self, self.kernel, self.schedule(), key, model=model, data=data, options=options)
