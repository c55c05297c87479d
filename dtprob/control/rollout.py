"""Playing a policy in an environment: trajectories, and long-run averages on arrivals common to all."""

from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dtprob.control.environment import Environment, Observation
from dtprob.control.policy import Memory, Policy, act
from dtprob.errors import InputError
from dtprob.twin.rollout import check_size


@final
class Stateless(eqx.Module):
    """A policy without memory as `dtprob.twin` takes it: from a key and the state at the start of a slot to actions.

    Attributes:
        policy: such as `tdma`, `aloha`, a `FramePolicy` or its table.

    Raises:
        InputError: a policy that remembers.
    """

    policy: Policy

    @property
    def devices(self) -> int | None:
        """How many, if the policy tells."""
        return getattr(self.policy, "devices", None)

    @property
    def capacity(self) -> int | None:
        """Packets that a buffer holds, if the policy tells."""
        return getattr(self.policy, "capacity", None)

    def __check_init__(self) -> None:
        """Refuse a policy that remembers, since a state does not hold what it does."""
        size = self.policy.initial().shape[1]
        if size:
            got, remedy = f"{size} numbers that each device remembers", "Give a FramePolicy or a table"
            raise InputError("policy", "one without memory", got, remedy)

    def __call__(self, key: PRNGKeyArray, state: Any) -> Int[Array, " device"]:
        """The devices' actions."""
        silent = jnp.zeros_like(state.buffer)
        seen = Observation(state.buffer, state.arrival, state.ack, silent, state.slot)
        return act(key, self.policy(self.policy.initial(), seen)[1])


class Trajectory(NamedTuple):
    """Consecutive slots of several environments; each leaf (slot, environment, ...).

    Attributes:
        observation: before the slot.
        start: whether an episode begins with the slot.
        action: what the devices wanted.
        logit: log-odds of sending that the policy gave.
        reward: of the slot.
        truncated: whether the episode was cut after the slot.
        slot: the kernel's account.
    """

    observation: Observation
    start: Bool[Array, "slot environment"]
    action: Int[Array, "slot environment device"]
    logit: Float[Array, "slot environment device"]
    reward: Float[Array, "slot environment"]
    truncated: Bool[Array, "slot environment"]
    slot: Any


class Play(NamedTuple):
    """Where several environments and a policy's memories stand; leaves (environment, ...)."""

    state: Any
    observation: Observation
    memory: Memory
    start: Bool[Array, " environment"]


def begin(key: PRNGKeyArray, environment: Environment, policy: Policy, count: int) -> Play:
    """Start episodes in `count` environments.

    Raises:
        InputError: a policy of other devices or smaller buffers.
    """
    check_size(environment.kernel, policy)
    keys = jax.random.split(key, count)
    state, observation = jax.vmap(environment.reset)(keys)
    memory = policy.initial()
    start = jnp.ones(count, bool)
    return Play(state, observation, jnp.broadcast_to(memory, (count, *memory.shape)), start)


def play(
    key: PRNGKeyArray, environment: Environment, policy: Policy, now: Play, slots: int
) -> tuple[Play, Trajectory]:
    """Go on for some slots.

    Args:
        key: typed JAX key.
        environment: the network.
        policy: that acts.
        now: where things stand.
        slots: how many, in each environment.
    """
    fresh = policy.initial()
    count = len(now.start)

    def one(now: Play, key: PRNGKeyArray) -> tuple[Play, Trajectory]:
        choose, move = jax.random.split(key)
        memory = jnp.where(now.start[:, None, None], fresh, now.memory)
        memory, logit = jax.vmap(policy)(memory, now.observation)
        action = act(choose, logit)
        state, result = jax.vmap(environment.step)(jax.random.split(move, count), now.state, action)
        record = Trajectory(
            now.observation, now.start, action, logit, result.reward, result.truncated, result.slot
        )
        return Play(state, result.observation, memory, result.truncated | result.terminated), record

    return jax.lax.scan(one, now, jax.random.split(key, slots))


class Metrics(NamedTuple):
    """Averages of one environment.

    Attributes:
        throughput: packets delivered per slot.
        overflow: packets lost per device and slot.
        reward: per slot.
    """

    throughput: Float[Array, " environment"]
    overflow: Float[Array, " environment"]
    reward: Float[Array, " environment"]


@eqx.filter_jit
def evaluate(
    key: PRNGKeyArray,
    environment: Environment,
    policy: Policy,
    slots: int,
    count: int,
) -> Metrics:
    """Averages over one long episode in each of several environments.

    With the same key all policies meet the same arrivals, as long as these do not depend on what is sent.

    Args:
        key: typed JAX key.
        environment: the network.
        policy: to judge.
        slots: of an episode; the environment's horizon should not be shorter.
        count: environments.
    """
    first, rest = jax.random.split(key)
    now = begin(first, environment, policy, count)

    def one(carry: tuple[Play, Metrics], key: PRNGKeyArray) -> tuple[tuple[Play, Metrics], None]:
        now, sums = carry
        now, got = play(key, environment, policy, now, 1)
        slot = got.slot
        new = (slot.delivered[0].sum(-1), slot.overflow[0].mean(-1), got.reward[0])
        return (now, Metrics(*(total + value for total, value in zip(sums, new, strict=True)))), None

    zero = jnp.zeros(count)
    (_, sums), _ = jax.lax.scan(one, (now, Metrics(zero, zero, zero)), jax.random.split(rest, slots))
    return Metrics(*(total / slots for total in sums))
