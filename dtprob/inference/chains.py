"""The device's side of a Markov chain run: pure functions of all chains' states."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dtprob.inference.kernel import STATS_TYPES, Kernel, Place, window_of
from dtprob.inference.target import Inputs, Target
from dtprob.inference.winding import recentred, redraw_winding

type ChainMethod = Literal["parallel", "vectorized"]

START, STEP = 0, 1


@dataclass(frozen=True)
class Walk:
    """How chains move; hashable, so that it is a setting of compiled functions.

    Attributes:
        kernel: the transition.
        method: "parallel" where each chain has calls of its own, "vectorized" where all are in one program.
        explore: steps after which the angles' windows are centred; 0 without angles.
        warmup: steps in all that are not kept.
        own: the arrays of the data of which each chain has its own, stacked on a leading axis, and then also its own
            units; none where all chains are of one posterior. Such chains run side by side.
    """

    kernel: Kernel
    method: ChainMethod
    explore: int
    warmup: int
    own: tuple[str, ...] = ()

    def over_chains(self, function: Callable[..., Any], inputs: Inputs, *stacked: Any) -> Any:
        """`function(inputs, ...)` for each chain, arguments and results stacked on a leading axis."""
        if self.own:
            axes = stacked_axes(inputs, self.own)
            return jax.vmap(function, in_axes=(axes, *[0] * len(stacked)))(inputs, *stacked)
        if self.method == "vectorized":
            return jax.vmap(functools.partial(function, inputs))(*stacked)
        return jax.lax.map(lambda arguments: function(inputs, *arguments), stacked)


def stacked_axes(inputs: Inputs, own: Sequence[str]) -> Any:
    """Inputs with the axis that each part is stacked on, None where it is shared: an argument of `jax.vmap`."""
    arrays: dict[str, Any] = {name: 0 if name in own else None for name in inputs.arrays}
    stacked: Any = 0
    return Inputs(arrays, stacked, stacked)


class Chain(NamedTuple):
    """State of one chain; the chains of a call are stacked on a leading axis.

    Attributes:
        kernel: the kernel's own state.
        centre: centres of the angles' windows, rad.
        resultant: running sum of (cos, sin) of the angles, from which the centres are found.
    """

    kernel: Any
    centre: Float[Array, " angle"]
    resultant: Float[Array, "angle 2"]


def start(
    target: Target,
    walk: Walk,
    points: Float[Array, "chain dimension"],
    keys: PRNGKeyArray,
    inputs: Inputs,
) -> Chain:
    """The chains at their starting points, nothing adapted yet."""

    def one(inputs: Inputs, point: Array, key: PRNGKeyArray) -> Chain:
        centre = point[target.angles]
        state = walk.kernel.init(target, jax.random.fold_in(key, START), point, Place(centre, inputs))
        return Chain(state, centre, jnp.zeros((*centre.shape, 2), point.dtype))

    return walk.over_chains(one, inputs, points, keys)


def advance(  # noqa: PLR0917  (settings first, since they are bound before compilation)
    target: Target,
    walk: Walk,
    rows: int,
    chains: Chain,
    keys: PRNGKeyArray,
    begin: Int[Array, ""],
    end: Int[Array, ""],
    inputs: Inputs,
) -> tuple[Chain, dict[str, Array]]:
    """Steps `begin` to `end` of all chains.

    Returns:
        the chains, and by name the positions and statistics of each step, (chain, rows, ...), of which the
        first end - begin are filled.
    """

    def one(inputs: Inputs, chain: Chain, key: PRNGKeyArray) -> tuple[Chain, dict[str, Array]]:
        def body(number: Array, carry: tuple[Chain, dict[str, Array]]) -> tuple[Chain, dict[str, Array]]:
            moved, row = _step(target, walk, carry[0], jax.random.fold_in(key, number), number, inputs)
            blocks = jax.tree.map(lambda block, x: block.at[number - begin].set(x), carry[1], row)
            return moved, blocks

        empty = {name: jnp.zeros(rows, kind) for name, kind in STATS_TYPES.items()}
        empty["position"] = jnp.zeros((rows, target.dimension))
        return jax.lax.fori_loop(begin, end, body, (chain, empty))

    return walk.over_chains(one, inputs, chains, jax.vmap(jax.random.fold_in, (0, None))(keys, STEP))


def _step(  # noqa: PLR0917
    target: Target, walk: Walk, chain: Chain, key: PRNGKeyArray, number: Array, inputs: Inputs
) -> tuple[Chain, dict[str, Array]]:
    move_key, winding_key = jax.random.split(key)
    state, stats = walk.kernel.step(target, move_key, chain.kernel, number, Place(chain.centre, inputs))
    chain = chain._replace(kernel=state)
    window = window_of(target, walk.kernel.position(state), chain.centre)
    stats = stats._replace(lp=stats.lp - window)
    if target.angles.size:
        chain = _turn(target, walk, chain, winding_key, number)
    row = {name: jnp.asarray(value, STATS_TYPES[name]) for name, value in stats._asdict().items()}
    return chain, row | {"position": walk.kernel.position(chain.kernel)}


def _turn(target: Target, walk: Walk, chain: Chain, key: PRNGKeyArray, number: Array) -> Chain:
    """Follow the angles while exploring, and centre their windows at the end; redraw winding numbers of draws."""
    before = walk.kernel.position(chain.kernel)
    angles = before[target.angles]
    follows = (number >= walk.explore // 2) & (number < walk.explore)
    resultant = chain.resultant + follows * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    is_explored = number == walk.explore - 1
    mean = jnp.arctan2(resultant[:, 1], resultant[:, 0])
    centre = jnp.where(is_explored, mean, chain.centre)
    settled = jnp.where(is_explored, recentred(angles, mean), angles)
    turned = jnp.where(number >= walk.warmup, redraw_winding(key, angles, chain.centre), settled)
    chain = chain._replace(resultant=resultant)
    return _shifted(target, walk, chain, before.at[target.angles].set(turned), centre)


def _shifted(target: Target, walk: Walk, chain: Chain, point: Array, centre: Array) -> Chain:
    """The chain at a point with other winding numbers, and windows about other centres."""
    window = jax.value_and_grad(functools.partial(window_of, target))
    old, old_slope = window(walk.kernel.position(chain.kernel), chain.centre)
    new, new_slope = window(point, centre)
    state = walk.kernel.shift(chain.kernel, point, new - old, new_slope - old_slope)
    return chain._replace(kernel=state, centre=centre)
