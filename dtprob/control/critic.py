"""Critics: a central one that sees all devices, at a cost linear in their number, and a local one."""

import itertools
from typing import cast, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dtprob.control.environment import Observation

_OWN = 4


def _grid(frame: int, capacity: int) -> Float[np.ndarray, "place seen"]:
    """Everything a device can see, as numbers: the phase, packets that wait, arrival, acknowledgement."""
    rows = itertools.product(range(frame), range(capacity + 1), range(2), range(2))
    return np.array([[*np.eye(frame)[f], 2 * b / capacity - 1, 2 * a - 1, 2 * k - 1] for f, b, a, k in rows])


def _place(observation: Observation, frame: int, capacity: int) -> Int[Array, " device"]:
    """The row of the grid that each device sees."""
    phase = (observation.slot % frame) * (capacity + 1)
    return ((phase + observation.buffer) * 2 + observation.arrival) * 2 + observation.ack


def _inputs(own: Float[Array, "device own"], frame: int, capacity: int) -> Float[Array, "device place seen"]:
    """For each device and row of the grid, what there is to know: the row, and who the device is."""
    grid = jnp.asarray(_grid(frame, capacity), own.dtype)
    shape = (len(own), len(grid))
    parts = jnp.broadcast_to(grid, (*shape, grid.shape[1])), jnp.broadcast_to(own[:, None], (*shape, _OWN))
    return jnp.concatenate(parts, axis=2)


@final
class CentralCritic(eqx.Module):
    """Value of sending and of silence of each device, given the actions of all others.

    The selected device has a network of its own; the others share one, and their outputs are summed. Both see one of
    few things, so that they are evaluated once for all of these, whatever the size of the batch; so is the head's first
    layer, which is linear in their outputs.

    Attributes:
        own: what tells the devices apart, learned.
        selected: of the device whose actions are valued, seen-32-32-16.
        other: of each other device and its action.
        head: from both to the two values, 32-32-2.
        frame: slots of the frame whose phase is seen.
        capacity: packets that a buffer holds.
    """

    own: Float[Array, "device own"]
    selected: eqx.nn.MLP
    other: eqx.nn.MLP
    head: eqx.nn.MLP
    frame: int = eqx.field(static=True)
    capacity: int = eqx.field(static=True)

    def __init__(self, key: PRNGKeyArray, devices: int, frame: int = 4, capacity: int = 1) -> None:
        keys = jax.random.split(key, 4)
        seen = 3 + frame + _OWN
        self.own = jax.random.normal(keys[0], (devices, _OWN))
        self.selected = eqx.nn.MLP(seen, 16, 32, 2, jax.nn.relu, key=keys[1])
        self.other = eqx.nn.MLP(seen + 1, 16, 32, 2, jax.nn.relu, key=keys[2])
        self.head = eqx.nn.MLP(32, 2, 32, 1, jax.nn.relu, key=keys[3])
        self.frame, self.capacity = frame, capacity

    def __call__(
        self, observation: Observation, action: Int[Array, " device"]
    ) -> Float[Array, "device choice"]:
        """Values of silence and of sending of each device while the others do as they did.

        Args:
            observation: of all devices.
            action: of all devices.
        """
        inputs = _inputs(self.own, self.frame, self.capacity)
        first, last = self.head.layers
        of_selected, of_others = jnp.split(first.weight, 2, axis=1)
        selected = jax.vmap(jax.vmap(self.selected))(inputs) @ of_selected.T + cast("Array", first.bias)
        sign = jnp.ones((*inputs.shape[:2], 1), inputs.dtype)
        acting = jnp.stack([jnp.concatenate([inputs, s * sign], axis=2) for s in (-1, 1)])
        other = jax.vmap(jax.vmap(jax.vmap(self.other)))(acting) @ of_others.T
        device, place = jnp.arange(len(self.own)), _place(observation, self.frame, self.capacity)
        sends = action * (observation.buffer > 0)
        each = other[sends, device, place]
        hidden = jax.nn.relu(selected[device, place] + jnp.sum(each, axis=0) - each)
        return hidden @ last.weight.T + cast("Array", last.bias)


@final
class LocalCritic(eqx.Module):
    """Value of where each device stands, by what it sees itself.

    Attributes:
        own: what tells the devices apart, learned.
        network: shared by the devices, seen-32-32-1.
        frame: slots of the frame whose phase is seen.
        capacity: packets that a buffer holds.
    """

    own: Float[Array, "device own"]
    network: eqx.nn.MLP
    frame: int = eqx.field(static=True)
    capacity: int = eqx.field(static=True)

    def __init__(self, key: PRNGKeyArray, devices: int, frame: int = 4, capacity: int = 1) -> None:
        first, second = jax.random.split(key)
        self.own = jax.random.normal(first, (devices, _OWN))
        self.network = eqx.nn.MLP(3 + frame + _OWN, 1, 32, 2, jnp.tanh, key=second)
        self.frame, self.capacity = frame, capacity

    def __call__(self, observation: Observation) -> Float[Array, " device"]:
        """The values."""
        table = jax.vmap(jax.vmap(self.network))(_inputs(self.own, self.frame, self.capacity))
        place = _place(observation, self.frame, self.capacity)
        return table[jnp.arange(len(self.own)), place, 0]
