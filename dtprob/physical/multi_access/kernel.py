"""The transition of a multi-access network in pure JAX: action, acknowledgement, arrival, in this order."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple, Self, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Scalar

from dtprob.physical.multi_access.network import Clusters, Network

type Parameters = Mapping[str, Float[Array, "..."]]


class State(NamedTuple):
    """Where the network stands at the start of a slot.

    Attributes:
        buffer: packets that wait at each device.
        arrival: whether a packet was generated at the end of the last slot.
        ack: whether a packet was delivered in the last slot.
        slot: slots since the episode began.
    """

    buffer: Int[Array, " device"]
    arrival: Int[Array, " device"]
    ack: Int[Array, " device"]
    slot: Int[Array, ""]


class Slot(NamedTuple):
    """What happened in a slot.

    Attributes:
        delivered: whether each device's packet got through.
        overflow: whether each device lost a new packet because its buffer was full.
        collision: whether some packet that was sent did not get through.
        reward: the sum over devices.
    """

    delivered: Int[Array, " device"]
    overflow: Int[Array, " device"]
    collision: Bool[Array, ""]
    reward: Float[Array, ""]


class Rewards(NamedTuple):
    """Reward of a device; the first that applies. The network's is the sum over devices."""

    delivered: float = 50.0
    overflow: float = -50.0
    otherwise: float = -1.0


REWARDS: Final = Rewards()
"""What the seed report pays."""


@final
@dataclass(frozen=True)
class PhysicalKernel:
    """The ground truth's transition.

    Attributes:
        clusters: as in `Network`.
        capacity: packets that a buffer holds.
        rewards: what the devices are paid for.
    """

    clusters: Clusters
    capacity: int = 1
    rewards: Rewards = REWARDS

    @classmethod
    def of(cls, network: Network) -> Self:
        """The transition of a network; its tables go to `step` as parameters."""
        return cls(network.clusters, network.capacity)

    @property
    def devices(self) -> int:
        """Number of devices."""
        return sum(len(cluster) for cluster in self.clusters)

    def initial(self) -> State:
        """Empty buffers, nothing generated, nothing acknowledged."""
        none = jnp.zeros(self.devices, jnp.int32)
        return State(none, none, none, jnp.zeros((), jnp.int32))

    def step(
        self, key: PRNGKeyArray, parameters: Parameters, state: State, action: Int[Array, " device"]
    ) -> tuple[State, Slot]:
        """One slot.

        Args:
            key: typed JAX key.
            parameters: `log_arrival` and `log_reception`, as `Network.parameters` gives them.
            state: at the slot's start.
            action: 1 to send, 0 to be silent; a device without a packet is silent.
        """
        devices, clusters = self.devices, len(self.clusters)
        uniform = jax.random.uniform(key, (_rounded(devices + clusters + 1),))
        sends = action.astype(state.buffer.dtype) * (state.buffer > 0)
        deliveries = _inverse(parameters["log_reception"][jnp.sum(sends)], uniform[0])
        ack = _choose(sends, deliveries, uniform[1 : devices + 1])
        arrival = self._arrivals(
            parameters["log_arrival"], state.arrival, uniform[devices + 1 : devices + 1 + clusters]
        )
        overflow = (state.buffer == self.capacity) * arrival * (1 - ack)
        buffer = jnp.clip(state.buffer + arrival - ack, 0, self.capacity)
        slot = Slot(ack, overflow, jnp.sum(sends) > deliveries, self._reward(ack, overflow))
        return State(buffer, arrival, ack, state.slot + 1), slot

    def _reward(self, ack: Int[Array, " device"], overflow: Int[Array, " device"]) -> Scalar:
        pay = self.rewards
        each = jnp.where(ack > 0, pay.delivered, jnp.where(overflow > 0, pay.overflow, pay.otherwise))
        return jnp.sum(each)

    def _arrivals(
        self,
        log_arrival: Float[Array, "cluster previous outcome"],
        last: Int[Array, " device"],
        uniform: Float[Array, " cluster"],
    ) -> Int[Array, " device"]:
        own, weight = _digits(self.clusters)
        if log_arrival.shape[1] == 1:
            row = log_arrival[:, 0]
        else:
            counted = last * weight
            previous = jnp.stack([counted[np.array(cluster)].sum() for cluster in self.clusters])
            row = log_arrival[jnp.arange(len(self.clusters)), previous]
        return (jax.vmap(_inverse)(row, uniform)[own] // weight) % 2


def _digits(clusters: Clusters) -> tuple[np.ndarray, np.ndarray]:
    """For each device, its cluster and the place value of its digit in an outcome."""
    own, weight = (np.zeros(sum(map(len, clusters)), np.int32) for _ in range(2))
    for number, cluster in enumerate(clusters):
        for place, device in enumerate(reversed(cluster)):
            own[device], weight[device] = number, 2**place
    return own, weight


def _rounded(count: int) -> int:
    """A multiple of 16: such rows of uniform numbers are drawn twice as fast as shorter ones, and begin the same."""
    return -(-count // 16) * 16


def _inverse(log_probability: Float[Array, " outcome"], uniform: Scalar) -> Int[Array, ""]:
    """The outcome whose share of [0, 1) holds `uniform`; never one of probability zero."""
    cumulative = jnp.cumsum(jnp.exp(log_probability))
    return jnp.sum(uniform >= cumulative / cumulative[-1], dtype=jnp.int32)


def _choose(
    sends: Int[Array, " device"], deliveries: Int[Array, ""], uniform: Float[Array, " device"]
) -> Int[Array, " device"]:
    """Which senders get through, uniformly: each in turn with chance deliveries left over senders left."""

    def one(left: tuple[Array, Array], device: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        places, senders = left
        sends, uniform = device
        wins = sends * (uniform * senders < places)
        return (places - wins, senders - sends), wins

    devices = len(sends)
    start = deliveries, jnp.sum(sends, dtype=sends.dtype)
    return jax.lax.scan(one, start, (sends, uniform), unroll=min(devices, 16))[1]
