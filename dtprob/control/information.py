"""Rewards for collecting data: what a slot is expected to tell about the parameters.

The reward of a slot is the mutual information of its outcome and the parameters, given the state, the action and
what the episode told before, I(s'; theta | s, a, episode so far). By the chain rule an episode's rewards sum to
what it tells in all. Given the state, a slot's outcome is a joint arrival of each cluster and a number of
deliveries; the devices' known parts tell nothing.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import digamma, xlogy
from jaxtyping import Array, Bool, Float, Int

type Clusters = tuple[Sequence[int], ...]


class Counts(NamedTuple):
    """How the tables' rows are known: concentrations of Dirichlet laws, 0 where an outcome cannot be.

    Attributes:
        arrival: of each joint arrival of a cluster given its last one.
        reception: of each number of deliveries given the number of senders.
    """

    arrival: Float[Array, "cluster previous outcome"]
    reception: Float[Array, "senders deliveries"]


class _Outcome(NamedTuple):
    """Rows and columns of the tables that a slot used."""

    previous: Int[Array, " cluster"]
    arrivals: Int[Array, " cluster"]
    senders: Int[Array, ""]
    deliveries: Int[Array, ""]


@final
class DirichletInformation(eqx.Module):
    """Expected information in closed form, where every row has a Dirichlet law of its own.

    Attributes:
        counts: the posterior at the start of each episode; the episode's outcomes add to it.
        clusters: the devices of each cluster.
    """

    counts: Counts
    clusters: Clusters = eqx.field(static=True)

    def initial(self) -> Counts:
        """The posterior."""
        return self.counts

    def __call__(
        self, memory: Counts, before: Any, action: Int[Array, " device"], after: Any, slot: Any
    ) -> tuple[Counts, Float[Array, ""]]:
        """See `dtprob.control.environment.Reward`; nats."""
        own = np.arange(len(self.clusters))
        now = _outcome(self.clusters, before, action, after, slot, rows=memory.arrival.shape[1])
        gain = jnp.sum(dirichlet_information(memory.arrival[own, now.previous]))
        gain += dirichlet_information(memory.reception[now.senders])
        arrival = memory.arrival.at[own, now.previous, now.arrivals].add(1.0)
        reception = memory.reception.at[now.senders, now.deliveries].add(1.0)
        return Counts(arrival, reception), gain


@final
class SampledInformation(eqx.Module):
    """Expected information by draws, for any posterior: H(E p) - E H(p) over draws weighted by the episode.

    Attributes:
        pool: draws of `log_arrival` and `log_reception`, each leaf (draw, ...).
        clusters: the devices of each cluster.
    """

    pool: dict[str, Float[Array, "draw ..."]]
    clusters: Clusters = eqx.field(static=True)

    def initial(self) -> Float[Array, " draw"]:
        """Equal log-weights."""
        return jnp.zeros(len(self.pool["log_reception"]))

    def __call__(
        self,
        memory: Float[Array, " draw"],
        before: Any,
        action: Int[Array, " device"],
        after: Any,
        slot: Any,
    ) -> tuple[Float[Array, " draw"], Float[Array, ""]]:
        """See `dtprob.control.environment.Reward`; nats."""
        own = np.arange(len(self.clusters))
        arrival, reception = self.pool["log_arrival"], self.pool["log_reception"]
        now = _outcome(self.clusters, before, action, after, slot, rows=arrival.shape[2])
        weight = jax.nn.softmax(memory)
        rows = arrival[:, own, now.previous]
        row = reception[:, now.senders]
        gain = jnp.sum(jax.vmap(sampled_information, (None, 1))(weight, rows))
        gain += sampled_information(weight, row)
        told = jnp.sum(rows[:, own, now.arrivals], axis=1) + row[:, now.deliveries]
        return memory + told, gain


def dirichlet_information(
    concentration: Float[Array, "*batch outcome"],
) -> Float[Array, "*batch"]:
    """Mutual information of an outcome and its law, which is Dirichlet: H(E p) - E H(p), nats.

    Args:
        concentration: 0 where an outcome cannot be.
    """
    total = jnp.sum(concentration, axis=-1, keepdims=True)
    mean = concentration / total
    entropy = -jnp.sum(xlogy(mean, mean), axis=-1)
    inside = jnp.where(concentration > 0, concentration, 1.0)
    each = jnp.where(concentration > 0, mean * digamma(inside + 1), 0.0)
    return entropy - (digamma(total[..., 0] + 1) - jnp.sum(each, axis=-1))


def sampled_information(
    weight: Float[Array, " draw"], log_probability: Float[Array, "draw outcome"]
) -> Float[Array, ""]:
    """The same by weighted draws of the law.

    Args:
        weight: of the draws; they sum to one.
        log_probability: of each outcome, -inf where it cannot be.
    """
    chance = jnp.exp(log_probability)
    mean = weight @ chance
    return jnp.sum(weight @ xlogy(chance, chance)) - jnp.sum(xlogy(mean, mean))


def _outcome(
    clusters: Clusters, before: Any, action: Int[Array, " device"], after: Any, slot: Any, *, rows: int
) -> _Outcome:
    sends: Bool[Array, " device"] = (action > 0) & (before.buffer > 0)
    previous = _encode(clusters, before.arrival) if rows > 1 else jnp.zeros(len(clusters), jnp.int32)
    return _Outcome(previous, _encode(clusters, after.arrival), jnp.sum(sends), jnp.sum(slot.delivered))


def _encode(clusters: Clusters, arrival: Int[Array, " device"]) -> Int[Array, " cluster"]:
    """Joint arrivals as binary numbers, the first device the most significant digit."""
    place = [2 ** np.arange(len(cluster))[::-1] for cluster in clusters]
    return jnp.stack([arrival[np.array(c)] @ p for c, p in zip(clusters, place, strict=True)])
