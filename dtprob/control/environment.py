"""A network as an environment in pure JAX: episodes, redrawn parameters, rewards. Vectorise it with `jax.vmap`."""

from typing import Any, NamedTuple, Protocol, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dtprob.control.kernel import Kernel, Parameters
from dtprob.errors import InputError


class Observation(NamedTuple):
    """What each device knows at the start of a slot, its last action among it.

    Attributes:
        buffer: packets that wait.
        arrival: whether a packet was generated at the end of the last slot.
        ack: whether a packet was delivered in the last slot.
        action: whether it wanted to send in the last slot.
        slot: slots since the episode began, common to all.
    """

    buffer: Int[Array, " device"]
    arrival: Int[Array, " device"]
    ack: Int[Array, " device"]
    action: Int[Array, " device"]
    slot: Int[Array, ""]


class EnvironmentState(NamedTuple):
    """An episode under way.

    Attributes:
        network: the kernel's state.
        action: of the last slot.
        draw: which of the pool's parameters hold.
        reward: what the reward remembers.
    """

    network: Any
    action: Int[Array, " device"]
    draw: Int[Array, ""]
    reward: Any


class Step(NamedTuple):
    """What a slot gave.

    Attributes:
        observation: to decide on next; the first of a new episode where this one ended.
        final_observation: what the slot led to, also where the episode ended there.
        reward: of the slot.
        terminated: the episode came to an end of its own; a network never does.
        truncated: the episode was cut at the horizon.
        slot: the kernel's account.
    """

    observation: Observation
    final_observation: Observation
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    slot: Any


class Reward(Protocol):
    """A reward of one's own, which may remember what happened in the episode."""

    def initial(self) -> Any:
        """What it remembers at the start of an episode."""
        ...

    def __call__(
        self, memory: Any, before: Any, action: Int[Array, " device"], after: Any, slot: Any
    ) -> tuple[Any, Float[Array, ""]]:
        """What it remembers then, and the reward.

        Args:
            memory: of the episode so far.
            before: the kernel's state.
            action: what the devices wanted.
            after: the next state.
            slot: the kernel's account.
        """
        ...


@final
class NetworkReward(eqx.Module):
    """The kernel's own reward."""

    def initial(self) -> None:
        """Nothing to remember."""
        return

    def __call__(
        self, memory: None, before: Any, action: Int[Array, " device"], after: Any, slot: Any
    ) -> tuple[None, Float[Array, ""]]:
        """The slot's reward."""
        del before, action, after
        return memory, slot.reward


@final
class Environment(eqx.Module):
    """Episodes of a network whose parameters come from a pool of draws.

    Each episode starts from empty buffers with a draw of its own; a new one follows by itself.

    Attributes:
        kernel: the transition.
        pool: draws of its parameters, each leaf (draw, ...); see `dtprob.control.draw_pool`.
        horizon: slots of an episode.
        redraw: slots after which other parameters are drawn within an episode; the horizon means never.
        reward: what is rewarded.
    """

    kernel: Kernel = eqx.field(static=True)
    pool: Parameters
    horizon: int = eqx.field(static=True)
    redraw: int = eqx.field(static=True)
    reward: Reward

    def __init__(
        self,
        kernel: Kernel,
        pool: Parameters,
        horizon: int = 2000,
        redraw: int | None = None,
        *,
        reward: Reward | None = None,
    ) -> None:
        self.kernel, self.pool = kernel, pool
        self.horizon = horizon
        self.redraw = horizon if redraw is None else redraw
        self.reward = NetworkReward() if reward is None else reward
        for name, value in (("horizon", self.horizon), ("redraw", self.redraw)):
            if value < 1:
                raise InputError(name, "1 slot or more", str(value), "Give a larger number")

    @property
    def devices(self) -> int:
        """Number of devices."""
        return self.kernel.devices

    def reset(self, key: PRNGKeyArray) -> tuple[EnvironmentState, Observation]:
        """Start an episode."""
        network = self.kernel.initial()
        silent = jnp.zeros_like(network.buffer)
        state = EnvironmentState(network, silent, _choice(key, self.pool), self.reward.initial())
        return state, observe(state)

    def step(
        self, key: PRNGKeyArray, state: EnvironmentState, action: Int[Array, " device"]
    ) -> tuple[EnvironmentState, Step]:
        """One slot; where the episode ends, the state is the start of the next.

        Args:
            key: typed JAX key.
            state: of the episode.
            action: 1 to send, 0 to be silent.
        """
        move, choose = jax.random.split(key)
        parameters = {name: draws[state.draw] for name, draws in self.pool.items()}
        network, slot = self.kernel.step(move, parameters, state.network, action)
        memory, reward = self.reward(state.reward, state.network, action, network, slot)
        drawn = _choice(choose, self.pool)
        draw = jnp.where(network.slot % self.redraw == 0, drawn, state.draw)
        after = EnvironmentState(network, action.astype(state.action.dtype), draw, memory)
        truncated = network.slot >= self.horizon
        start = EnvironmentState(
            self.kernel.initial(), jnp.zeros_like(after.action), drawn, self.reward.initial()
        )
        going = jax.tree.map(lambda new, old: jnp.where(truncated, new, old), start, after)
        terminated = jnp.zeros((), bool)
        return going, Step(observe(going), observe(after), reward, terminated, truncated, slot)


def observe(state: EnvironmentState) -> Observation:
    """What the devices see."""
    network = state.network
    return Observation(network.buffer, network.arrival, network.ack, state.action, network.slot)


def _choice(key: PRNGKeyArray, pool: Parameters) -> Int[Array, ""]:
    count = len(next(iter(pool.values())))
    return jax.random.randint(key, (), 0, count, jnp.int32)
