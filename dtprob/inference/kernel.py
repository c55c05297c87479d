"""What the run loop needs of a Markov chain kernel, and the density that kernels walk on."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, Scalar

from dtprob.inference.target import Inputs, Target
from dtprob.inference.winding import log_window


class Place(NamedTuple):
    """What a chain's density depends on besides the position.

    Attributes:
        centre: for each angle, the centre of its window, rad, (angle,); see `dtprob.inference.winding`.
        inputs: the target's arrays.
    """

    centre: Float[Array, " angle"]
    inputs: Inputs


class Stats(NamedTuple):
    """Statistics of one transition, each a scalar.

    Attributes:
        lp: log density that the kernel walks on, where it ended.
        diverging: whether the trajectory left the typical set for good.
        energy: of the place, with its momentum.
        tree_depth: doublings of the trajectory.
        acceptance_rate: mean over the trajectory.
        step_size: of the leapfrog steps.
    """

    lp: Array
    diverging: Array
    energy: Array
    tree_depth: Array
    acceptance_rate: Array
    step_size: Array


STATS_TYPES = dict.fromkeys(Stats._fields, float) | {"diverging": bool, "tree_depth": int}
"""What each statistic is kept as."""


class Kernel(Protocol):
    """A Markov chain kernel as pure functions of one chain; the run loop maps them over chains.

    A kernel is hashable, since compiled functions are kept by it. Its state is a pytree of arrays without
    keys.
    """

    @property
    def warmup(self) -> int:
        """Number of first steps in which the kernel adapts itself."""
        ...

    def init(self, target: Target, key: PRNGKeyArray, position: Array, place: Place) -> Any:
        """State of a chain that starts at a position, nothing adapted yet."""
        ...

    def step(
        self, target: Target, key: PRNGKeyArray, state: Any, index: Array, place: Place
    ) -> tuple[Any, Stats]:
        """One transition; it adapts itself while `index` is below `warmup`."""
        ...

    def position(self, state: Any) -> Float[Array, " dimension"]:
        """Where the chain is."""
        ...

    def shift(self, state: Any, position: Array, log_density: Array, gradient: Array) -> Any:
        """The state moved to a position where log density and gradient differ by the given amounts."""
        ...


def lifted_log_density(target: Target, u: Float[Array, " dimension"], place: Place) -> Scalar:
    """The log density over the reals that kernels sample: the target's, angles lifted.

    Args:
        target: the target.
        u: the point.
        place: centres of the angles' windows, and the target's arrays.
    """
    return target.log_density(u, place.inputs) + window_of(target, u, place.centre)


def window_of(target: Target, u: Float[Array, " dimension"], centre: Float[Array, " angle"]) -> Scalar:
    """The part of the lifted log density that the windows add."""
    if not target.circular.any():
        return jnp.zeros(())
    return log_window(u[target.angles] - centre)
