"""Critics: a central one that sees all devices, at a cost linear in their number, and a local one."""

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from dtprob.control.environment import Observation

_OWN = 4


def _features(
    observation: Observation, frame: int, own: Float[Array, "device own"]
) -> Float[Array, "device seen"]:
    """What there is to know of each device: its observation, the slot's place in the frame, who it is."""
    seen: list[Any] = [observation.buffer, observation.arrival, observation.ack]
    local = 2.0 * jnp.stack(seen, axis=-1) - 1.0
    phase = jax.nn.one_hot(observation.slot % frame, frame)
    return jnp.concatenate([local, jnp.broadcast_to(phase, (len(local), frame)), own], axis=1)


@final
class CentralCritic(eqx.Module):
    """Value of sending and of silence of each device, given the actions of all others.

    The selected device has a network of its own; the others share one, and their outputs are summed.

    Attributes:
        own: what tells the devices apart, learned.
        selected: of the device whose actions are valued, seen-32-32-16.
        other: of each other device and its action.
        head: from both to the two values, 32-32-2.
        frame: slots of the frame whose phase is seen.
    """

    own: Float[Array, "device own"]
    selected: eqx.nn.MLP
    other: eqx.nn.MLP
    head: eqx.nn.MLP
    frame: int = eqx.field(static=True)

    def __init__(self, key: PRNGKeyArray, devices: int, frame: int = 4) -> None:
        keys = jax.random.split(key, 4)
        seen = 3 + frame + _OWN
        self.own = jax.random.normal(keys[0], (devices, _OWN))
        self.selected = eqx.nn.MLP(seen, 16, 32, 2, jax.nn.relu, key=keys[1])
        self.other = eqx.nn.MLP(seen + 1, 16, 32, 2, jax.nn.relu, key=keys[2])
        self.head = eqx.nn.MLP(32, 2, 32, 1, jax.nn.relu, key=keys[3])
        self.frame = frame

    def __call__(
        self, observation: Observation, action: Int[Array, " device"]
    ) -> Float[Array, "device choice"]:
        """Values of silence and of sending of each device while the others do as they did.

        Args:
            observation: of all devices.
            action: of all devices.
        """
        seen = _features(observation, self.frame, self.own)
        sends = 2.0 * (action * (observation.buffer > 0))[:, None] - 1.0
        each = jax.vmap(self.other)(jnp.concatenate([seen, sends], axis=1))
        rest = jnp.sum(each, axis=0) - each
        return jax.vmap(self.head)(jnp.concatenate([jax.vmap(self.selected)(seen), rest], axis=1))


@final
class LocalCritic(eqx.Module):
    """Value of where each device stands, by what it sees itself.

    Attributes:
        own: what tells the devices apart, learned.
        network: shared by the devices, seen-32-32-1.
        frame: slots of the frame whose phase is seen.
    """

    own: Float[Array, "device own"]
    network: eqx.nn.MLP
    frame: int = eqx.field(static=True)

    def __init__(self, key: PRNGKeyArray, devices: int, frame: int = 4) -> None:
        first, second = jax.random.split(key)
        self.own = jax.random.normal(first, (devices, _OWN))
        self.network = eqx.nn.MLP(3 + frame + _OWN, 1, 32, 2, jnp.tanh, key=second)
        self.frame = frame

    def __call__(self, observation: Observation) -> Float[Array, " device"]:
        """The values."""
        return jax.vmap(self.network)(_features(observation, self.frame, self.own))[:, 0]
