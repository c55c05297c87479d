"""Decentralised policies: each device decides by what it sees itself and the slot of the frame."""

from typing import Any, Protocol, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dtprob.control.environment import Observation
from dtprob.errors import InputError

type Memory = Float[Array, "device size"]


class Policy(Protocol):
    """A rule of access for all devices; a pytree, in which no device sees another's observation."""

    def initial(self) -> Memory:
        """What the devices remember at the start of an episode; of size 0 where they remember nothing."""
        ...

    def __call__(self, memory: Memory, observation: Observation) -> tuple[Memory, Float[Array, " device"]]:
        """What they remember then, and the log-odds of sending."""
        ...


@final
class FramePolicy(eqx.Module):
    """Memoryless: a network per device gives the chance of sending in each slot of a frame.

    Attributes:
        networks: of all devices, 3-32-32-frame with tanh; leaves (device, ...).
        devices: how many.
        frame: slots of a frame.
        capacity: packets that a buffer holds.
    """

    networks: eqx.nn.MLP
    devices: int = eqx.field(static=True)
    frame: int = eqx.field(static=True)
    capacity: int = eqx.field(static=True)

    def __init__(
        self, key: PRNGKeyArray, devices: int, frame: int = 4, capacity: int = 1, *, width: int = 32
    ) -> None:
        def one(key: PRNGKeyArray) -> eqx.nn.MLP:
            return eqx.nn.MLP(3, frame, width, 2, jnp.tanh, key=key)

        self.networks = eqx.filter_vmap(one)(jax.random.split(key, devices))
        self.devices, self.frame, self.capacity = devices, frame, capacity

    def initial(self) -> Memory:
        """Nothing."""
        return jnp.zeros((self.devices, 0))

    def table(self) -> Float[Array, "device buffer arrival ack phase"]:
        """The log-odds of sending for everything a device can see."""
        ranges = (self.capacity + 1, 2, 2)
        grid = jnp.stack(jnp.meshgrid(*(jnp.linspace(-1.0, 1.0, n) for n in ranges), indexing="ij"), axis=-1)
        of_all = jax.vmap(jax.vmap(jax.vmap(lambda network, x: network(x), (None, 0)), (None, 0)), (None, 0))
        return eqx.filter_vmap(of_all, in_axes=(eqx.if_array(0), None))(self.networks, grid)

    def __call__(self, memory: Memory, observation: Observation) -> tuple[Memory, Float[Array, " device"]]:
        """See `Policy`."""
        seen = observation.buffer, observation.arrival, observation.ack
        return memory, self.table()[jnp.arange(self.devices), *seen, observation.slot % self.frame]


@final
class HistoryPolicy(eqx.Module):
    """A gated recurrent network per device reads its actions and observations, slot after slot.

    Attributes:
        cells: of all devices; leaves (device, ...).
        heads: from what is remembered and seen to the log-odds of sending.
        devices: how many.
        frame: slots of the frame whose phase the devices know.
    """

    cells: eqx.nn.GRUCell
    heads: eqx.nn.MLP
    devices: int = eqx.field(static=True)
    frame: int = eqx.field(static=True)

    def __init__(self, key: PRNGKeyArray, devices: int, frame: int = 4, width: int = 16) -> None:
        def one(key: PRNGKeyArray) -> tuple[eqx.nn.GRUCell, eqx.nn.MLP]:
            first, second = jax.random.split(key)
            seen = 4 + frame
            cell = eqx.nn.GRUCell(seen, width, key=first)
            return cell, eqx.nn.MLP(width + seen, 1, 32, 1, jnp.tanh, key=second)

        self.cells, self.heads = eqx.filter_vmap(one)(jax.random.split(key, devices))
        self.devices, self.frame = devices, frame

    def initial(self) -> Memory:
        """Zeros."""
        return jnp.zeros((self.devices, self.cells.hidden_size))

    def __call__(self, memory: Memory, observation: Observation) -> tuple[Memory, Float[Array, " device"]]:
        """See `Policy`."""
        phase = jax.nn.one_hot(observation.slot % self.frame, self.frame)
        seen = jnp.concatenate(
            [_local(observation), jnp.broadcast_to(phase, (self.devices, self.frame))], axis=1
        )

        def one(cell: eqx.nn.GRUCell, head: eqx.nn.MLP, memory: Array, seen: Array) -> tuple[Array, Array]:
            after = cell(seen, memory)
            return after, head(jnp.concatenate([after, seen]))[0]

        return eqx.filter_vmap(one)(self.cells, self.heads, memory, seen)


@final
class TablePolicy(eqx.Module):
    """A chance of sending for everything a device can see: what a small device can run.

    Attributes:
        probability: by slot of the frame, device, packets that wait, arrival and acknowledgement.
    """

    probability: Float[Array, "phase device buffer arrival ack"]

    @property
    def devices(self) -> int:
        """How many."""
        return self.probability.shape[1]

    @property
    def capacity(self) -> int:
        """Packets that a buffer holds."""
        return self.probability.shape[2] - 1

    def initial(self) -> Memory:
        """Nothing."""
        return jnp.zeros((self.probability.shape[1], 0))

    def __call__(self, memory: Memory, observation: Observation) -> tuple[Memory, Float[Array, " device"]]:
        """See `Policy`."""
        phase = self.probability[observation.slot % len(self.probability)]
        device = jnp.arange(phase.shape[0])
        chance = phase[device, observation.buffer, observation.arrival, observation.ack]
        return memory, jnp.log(chance) - jnp.log1p(-chance)


def tdma(devices: int, capacity: int, frame: list[list[int]]) -> TablePolicy:
    """Devices take turns.

    Args:
        devices: how many.
        capacity: packets that a buffer holds.
        frame: for each slot of the frame, the devices that send in it, if any.

    Raises:
        InputError: a device that there is not.
    """
    table = jnp.zeros((len(frame), devices, capacity + 1, 2, 2))
    for phase, members in enumerate(frame):
        if not set(members) <= set(range(devices)):
            expected, got = f"devices from 0 to {devices - 1}", f"{members} in slot {phase}"
            raise InputError("frame", expected, got, "Number the devices from 0")
        table = table.at[phase, jnp.array(members, jnp.int32)].set(1.0)
    return TablePolicy(table)


def aloha(devices: int, capacity: int, probability: float) -> TablePolicy:
    """Every device with a packet sends with the same chance in every slot.

    Raises:
        InputError: a probability outside of [0, 1].
    """
    if isinstance(probability, int | float) and not 0 <= probability <= 1:
        raise InputError("probability of aloha", "a number from 0 to 1", f"{probability:g}", "Correct it")
    return TablePolicy(jnp.full((1, devices, capacity + 1, 2, 2), probability))


def tabulate(policy: FramePolicy) -> TablePolicy:
    """The table of a memoryless policy; it sends with the same chances."""
    return TablePolicy(jax.nn.sigmoid(jnp.moveaxis(policy.table(), -1, 0)))


def unroll(
    policy: Policy, memory: Memory, observations: Observation, starts: Bool[Array, " slot"]
) -> tuple[Memory, Float[Array, "slot device"]]:
    """Log-odds over consecutive slots.

    Args:
        policy: to follow.
        memory: before the first slot.
        observations: each leaf (slot, ...).
        starts: whether an episode begins at a slot.
    """
    fresh = policy.initial()
    if fresh.shape[1] == 0:
        return memory, jax.vmap(lambda seen: policy(fresh, seen)[1])(observations)

    def one(memory: Memory, slot: tuple[Observation, Array]) -> tuple[Memory, Array]:
        return policy(jnp.where(slot[1], fresh, memory), slot[0])

    return jax.lax.scan(one, memory, (observations, starts))


def unroll_each(
    policy: Policy,
    memory: Memory,
    observations: Observation,
    starts: Bool[Array, "slot environment"],
) -> Float[Array, "slot environment device"]:
    """Log-odds over consecutive slots of every environment; see `unroll`."""
    return jax.vmap(unroll, (None, 0, 1, 1), (0, 1))(policy, memory, observations, starts)[1]


def choice_entropy(logit: Float[Array, "..."]) -> Float[Array, "..."]:
    """Entropy, nats, of the choice to send or to be silent given the log-odds of sending."""
    chance = jax.nn.sigmoid(logit)
    return -chance * jax.nn.log_sigmoid(logit) - (1 - chance) * jax.nn.log_sigmoid(-logit)


def log_chance(logit: Float[Array, "..."], action: Int[Array, "..."]) -> Float[Array, "..."]:
    """Log-probability of an action given the log-odds of sending."""
    return jax.nn.log_sigmoid(jnp.where(action > 0, logit, -logit))


def act(key: PRNGKeyArray, logit: Float[Array, "..."]) -> Int[Array, "..."]:
    """Draw actions."""
    uniform = jax.random.uniform(key, (logit.size,)).reshape(
        logit.shape
    )  # one long row is drawn 6 times as fast
    return (uniform < jax.nn.sigmoid(logit)).astype(jnp.int32)


def _local(observation: Observation) -> Float[Array, "device seen"]:
    """What each device sees, as numbers around zero: buffer, arrival, acknowledgement, last action."""
    seen: list[Any] = [observation.buffer, observation.arrival, observation.ack, observation.action]
    return 2.0 * jnp.stack(seen, axis=-1) - 1.0
