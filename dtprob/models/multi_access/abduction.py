"""The luck that a logged slot must have had: draws of the exogenous noise given what happened."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from dtprob.models.multi_access.transition import Kernel, Noise, Parameters, State


class Transition(NamedTuple):
    """A logged slot.

    Attributes:
        state: at its start.
        action: 1 where a device was told to transmit, (device,).
        delivered: 1 where a packet was delivered, (device,).
        arrival: 1 where a packet was generated at its end, (device,).
    """

    state: State
    action: Int[Array, " device"]
    delivered: Int[Array, " device"]
    arrival: Int[Array, " device"]


def abduct(
    kernel: Kernel, key: PRNGKeyArray, parameters: Parameters, happened: Transition
) -> tuple[Noise, Bool[Array, ""]]:
    """A draw of a slot's noise given what happened, and whether it could happen at all.

    Given it, `Kernel.respond` gives back the slot with the logged action, and what would have been with another action
    or other parameters. Source: abduction, action, prediction; Pearl, Causality (2009), sec. 7.1.

    Args:
        kernel: the system.
        key: typed JAX key.
        parameters: under which the slot happened.
        happened: the slot.
    """
    keys = jax.random.split(key, 3)
    sender = (happened.action > 0) & (happened.state.buffer > 0)
    row = parameters["log_reception"][jnp.sum(sender)]
    reception, possible = _within(row, jnp.sum(happened.delivered), jax.random.uniform(keys[0]))
    table = parameters["log_arrival"]
    clusters = jnp.arange(table.shape[0])
    joint = kernel.clusters.encode(happened.arrival)
    previous = (
        kernel.clusters.encode(happened.state.arrival) if table.shape[1] > 1 else jnp.zeros_like(clusters)
    )
    uniform = jax.random.uniform(keys[1], clusters.shape)
    arrival, each = jax.vmap(_within)(table[clusters, previous], joint, uniform)
    rank = _ranked(jax.random.uniform(keys[2], (kernel.devices,)), sender, happened.delivered > 0)
    could = possible & jnp.all(each) & ~jnp.any((happened.delivered > 0) & ~sender)
    return Noise(arrival, reception, rank), could


def _within(
    log_probability: Float[Array, " outcome"], outcome: Int[Array, ""], uniform: Float[Array, ""]
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """A uniform number among those that the inverse distribution function takes to an outcome."""
    total = jnp.cumsum(jnp.exp(log_probability))
    total = total / total[-1]
    low = jnp.where(outcome > 0, total[outcome - 1], 0.0)
    high = total[outcome]
    return jnp.clip(low + uniform * (high - low), low, jnp.nextafter(high, low)), high > low


def _ranked(
    rank: Float[Array, " device"], sender: Bool[Array, " device"], delivered: Bool[Array, " device"]
) -> Float[Array, " device"]:
    """The ranks of the senders dealt out anew, in their order, so that those delivered have the lowest."""
    order = jnp.argsort(jnp.argsort(jnp.where(sender, jnp.where(delivered, 0.0, 4.0) + rank, 8.0)))
    sorted_ = jnp.sort(jnp.where(sender, rank, 2.0))
    return jnp.where(sender, sorted_[order], rank)
