"""One slot of the multi-access system as a function of its parameters: what control and prediction run on.

All randomness of a slot is one `Noise`, uniform numbers that the parameters turn into outcomes, so that a slot can be
run again with the same luck and other parameters or actions.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dtprob.errors import InputError
from dtprob.models.multi_access.clusters import Clusters

type Parameters = Mapping[str, Array]
"""`log_arrival` (cluster, previous, outcome) and `log_reception` (sender_count, delivery_count)."""

SITES: Final = ("log_arrival", "log_reception")
"""The sites of the model that a slot takes."""


class State(NamedTuple):
    """What the network is in at the start of a slot.

    Attributes:
        buffer: packets waiting, (device,).
        arrival: 1 where a packet was generated at the end of the last slot, (device,).
        ack: 1 where a packet was delivered in the last slot, (device,).
        slot: number of the slot from 0.
    """

    buffer: Int[Array, " device"]
    arrival: Int[Array, " device"]
    ack: Int[Array, " device"]
    slot: Int[Array, ""]


class Slot(NamedTuple):
    """What happened in a slot.

    Attributes:
        delivered: 1 where a packet was delivered, (device,).
        overflow: 1 where a packet was lost because the buffer was full, (device,).
        collision: 1 where not every sender was heard.
        reward: sum over devices: gain per delivery, else loss per overflow, else cost.
    """

    delivered: Int[Array, " device"]
    overflow: Int[Array, " device"]
    collision: Int[Array, ""]
    reward: Float[Array, ""]


class Noise(NamedTuple):
    """The luck of a slot: independent, uniform on [0, 1).

    Attributes:
        arrival: of each cluster's joint arrivals, (cluster,).
        reception: of the number of deliveries.
        rank: of each device, (device,); of the senders the lowest are delivered.
    """

    arrival: Float[Array, " cluster"]
    reception: Float[Array, ""]
    rank: Float[Array, " device"]


@final
class Kernel(eqx.Module):
    """The multi-access system: joint arrivals per cluster, multi-packet reception, finite buffers.

    Order inside a slot: action, acknowledgement, arrival, b' = clip(b + arrival - ack, 0, capacity). A device with
    an empty buffer is silent whatever its action; who of the senders is delivered is uniform.

    Attributes:
        clusters: the devices' clusters.
        capacity: of each buffer, packets.
        gain: reward of a delivery.
        loss: reward of an overflow without delivery.
        cost: reward of a device with neither.
    """

    clusters: Clusters = eqx.field(static=True)
    capacity: int = eqx.field(static=True, default=1)
    gain: float = eqx.field(static=True, default=50.0)
    loss: float = eqx.field(static=True, default=-50.0)
    cost: float = eqx.field(static=True, default=-1.0)

    @property
    def devices(self) -> int:
        """Number of devices."""
        return self.clusters.devices

    def initial(self) -> State:
        """Empty buffers, nothing arrived, nothing acknowledged."""
        zero = jnp.zeros(self.devices, jnp.int32)
        return State(zero, zero, zero, jnp.zeros((), jnp.int32))

    def draw(self, key: PRNGKeyArray) -> Noise:
        """The luck of one slot."""
        clusters = len(self.clusters.members)
        uniform = jax.random.uniform(key, (clusters + 1 + self.devices,))
        return Noise(uniform[:clusters], uniform[clusters], uniform[clusters + 1 :])

    def step(
        self, key: PRNGKeyArray, parameters: Parameters, state: State, action: Int[Array, " device"]
    ) -> tuple[State, Slot]:
        """One slot.

        Args:
            key: typed JAX key.
            parameters: the tables of log-probabilities.
            state: at the start of the slot.
            action: 1 where a device transmits.
        """
        return self.respond(self.draw(key), parameters, state, action)

    def respond(
        self, noise: Noise, parameters: Parameters, state: State, action: Int[Array, " device"]
    ) -> tuple[State, Slot]:
        """One slot with given luck; see `step`."""
        sender = (jnp.asarray(action) > 0) & (state.buffer > 0)
        count = jnp.sum(sender)
        deliveries = invert(parameters["log_reception"][count], noise.reception)
        ack = lowest(noise.rank, sender, deliveries)
        table = parameters["log_arrival"]
        clusters = jnp.arange(table.shape[0])
        previous = self.clusters.encode(state.arrival) if table.shape[1] > 1 else jnp.zeros_like(clusters)
        joint = jax.vmap(invert)(table[clusters, previous], noise.arrival)
        arrival = self.clusters.decode(joint)
        full = state.buffer + arrival - ack
        overflow = (full > self.capacity).astype(jnp.int32)
        reward = jnp.where(ack > 0, self.gain, jnp.where(overflow > 0, self.loss, self.cost))
        collision = (deliveries < count).astype(jnp.int32)
        after = State(jnp.clip(full, 0, self.capacity), arrival, ack, state.slot + 1)
        return after, Slot(ack, overflow, collision, jnp.sum(reward))


def kernel(clusters: Sequence[Sequence[int]], capacity: int = 1) -> Kernel:
    """The multi-access system of some clusters of devices.

    Args:
        clusters: the devices of each cluster, as ((0, 1), (2, 3)).
        capacity: of each buffer, packets.

    Raises:
        InputError: devices not numbered from 0, each in one cluster, or a capacity below 1.
        TypeError: a capacity that is no whole number.
    """
    capacity = operator.index(capacity)
    if capacity < 1:
        raise InputError("capacity of the buffers", "1 packet or more", str(capacity), "Give a larger number")
    return Kernel(Clusters(tuple(clusters)), capacity)


def invert(log_probability: Float[Array, " outcome"], uniform: Float[Array, ""]) -> Int[Array, ""]:
    """The outcome at a quantile, by the inverse distribution function; never one of probability zero."""
    total = jnp.cumsum(jnp.exp(log_probability))
    return jnp.sum(uniform >= total / total[-1], dtype=jnp.int32)


def lowest(
    rank: Float[Array, " device"], sender: Bool[Array, " device"], count: Int[Array, ""]
) -> Int[Array, " device"]:
    """1 at the `count` senders of the lowest rank, the earlier device first where two are equal.

    Comparing all pairs is faster than sorting for as many devices as a network has.
    """
    device = jnp.arange(rank.shape[-1])
    before = (rank < rank[:, None]) | ((rank == rank[:, None]) & (device < device[:, None]))
    place = jnp.sum(before & sender, axis=-1)
    return (sender & (place < count)).astype(jnp.int32)
