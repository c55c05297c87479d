"""The multi-access system as a generative model of its log: a factored transition model with unknown tables.

Factors: the joint arrivals of each cluster; the number of deliveries given the number of senders; and which of the
senders are delivered, uniform unless an effect favours some. The buffer's rule is known. Source: Ruah, Simeone and
Al-Hashimi, arXiv 2212.01351.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from jaxtyping import Array, Bool, Float, Int

from dtprob.errors import InputError, unknown_name
from dtprob.models.declaration import Measure, model
from dtprob.models.factored import Columns, Factor, draw_factors, log_table, look_up
from dtprob.models.multi_access.clusters import Clusters
from dtprob.models.multi_access.transition import lowest

type Traffic = Literal["memoryless", "markov"]

TRAFFIC: tuple[Traffic, ...] = ("memoryless", "markov")

AXES: Mapping[str, tuple[str, ...]] = {
    "log_arrival": ("cluster", "previous", "arrival_outcome"),
    "log_reception": ("sender_count", "delivery_count"),
    "arrival_logits": ("episode", "slot", "cluster", "arrival_outcome"),
    "reception_logits": ("episode", "slot", "delivery_count"),
    "device_advantage": ("episode", "slot", "device"),
    "success_logits": ("episode", "slot", "device", "success_outcome"),
}


def _generated(sites: Mapping[str, Any], data: Mapping[str, Any]) -> tuple[Array, Array]:
    """Packets generated in a slot, all devices together: (episode, slot) each."""
    clusters = data["clusters"]
    law = jax.nn.softmax(sites["arrival_logits"])
    expected = jnp.sum(law * clusters.arrives.sum(axis=1), axis=(-2, -1))
    return expected, jnp.sum(clusters.decode(sites["arrivals"]), axis=-1)


def _delivered(sites: Mapping[str, Any], _: Mapping[str, Any]) -> tuple[Array, Array]:
    """Packets delivered in a slot: (episode, slot) each."""
    law = jax.nn.softmax(sites["reception_logits"])
    return law @ jnp.arange(law.shape[-1]), sites["deliveries"]


MEASURES: Final = {
    "load_error": Measure("deliveries", _generated),
    "throughput_error": Measure("deliveries", _delivered),
}
"""Packets per slot, by window."""


@model(axes=AXES, cluster="episode", measures=MEASURES)
def multi_access(
    sending: Bool[Array, "episode slot device"],
    previous: Int[Array, "episode slot cluster"],
    valid: Bool[Array, "episode slot"],
    *,
    clusters: Clusters,
    traffic: Traffic = "memoryless",
    concentration: float = 0.01,
    acknowledged: Int[Array, "episode slot cluster"] | None = None,  # noqa: ARG001 -- read by effects
    preceded: Bool[Array, "episode slot"] | None = None,
    arrivals: Int[Array, "episode slot cluster"] | None = None,
    deliveries: Int[Array, "episode slot"] | None = None,
    successes: Int[Array, "episode slot device"] | None = None,
) -> None:
    """What a slotted network does in each slot, given the state and the actions at its start.

    `records` makes the arguments from a log. Given them all slots are independent, so an episode of the model may
    be a window of a longer one. Sites: `log_arrival` (cluster, previous, outcome), `log_reception` (sender_count,
    delivery_count), the tables; `arrival_logits`, `reception_logits`, `success_logits`, of each slot;
    `device_advantage` (1, 1, device), the log-odds that a device is heard rather than another sender.

    Args:
        sending: where a device transmitted a packet.
        previous: joint arrivals of each cluster at the end of the slot before; see `Clusters`.
        valid: false where an episode is shorter than the longest.
        clusters: the devices whose arrivals are drawn together.
        traffic: "markov" where arrivals depend on the cluster's last ones.
        concentration: of the Dirichlet priors of all tables.
        acknowledged: whose packets were delivered in the slot before, numbered as `previous`. The tables do not depend on
            it; traffic that waits for an acknowledgement is an effect, `closed_loop_traffic`.
        preceded: whether the slot before is known, as it is not after a gap; everywhere by default. Where it is not, what
            the arrivals depend on is not known, and they do not count.
        arrivals: joint arrivals of each cluster at the end of the slot.
        deliveries: number of packets delivered in the slot.
        successes: 1 where a device's packet was delivered.
    """
    memory = traffic == "markov"
    _check(clusters, traffic)
    sending, valid = jnp.asarray(sending, bool), jnp.asarray(valid, bool)
    arrival_table = log_table("log_arrival", concentration, clusters.arrival_allowed(memory=memory))
    reception_table = log_table("log_reception", concentration, clusters.reception_allowed())

    def arrival(columns: Columns) -> Array:
        last = columns["previous"] if memory else jnp.zeros_like(columns["previous"])
        return look_up(arrival_table, [jnp.broadcast_to(jnp.arange(last.shape[-1]), last.shape), last])

    def reception(columns: Columns) -> Array:
        return look_up(reception_table, [jnp.sum(columns["sending"], axis=-1)])

    traced = valid if preceded is None else valid & jnp.asarray(preceded, bool)
    columns: dict[str, Any] = {"sending": sending, "previous": previous, "valid": valid, "traced": traced}
    columns |= {"arrivals": arrivals, "deliveries": deliveries}
    factors = (
        Factor("arrival", "arrivals", ("previous",), arrival, ("cluster",), "traced"),
        Factor("reception", "deliveries", ("sending",), reception, (), "valid"),
    )
    drawn = draw_factors(factors, {k: v for k, v in columns.items() if v is not None})
    _draw_successes(sending, drawn["deliveries"], valid, successes)


def _check(clusters: Clusters, traffic: Traffic) -> None:
    if not isinstance(clusters, Clusters):
        remedy = "Write Clusters(((0, 1), (2, 3)))"
        raise InputError("clusters", "dtprob.models.multi_access.Clusters", type(clusters).__name__, remedy)
    if traffic not in TRAFFIC:
        raise unknown_name("traffic", str(traffic), TRAFFIC, "kind of traffic")


def _draw_successes(
    sending: Bool[Array, "episode slot device"],
    deliveries: Int[Array, "episode slot"],
    valid: Bool[Array, "episode slot"],
    successes: Int[Array, "episode slot device"] | None,
) -> None:
    """Which senders are delivered, device after device, each given those before it."""
    advantage = jnp.zeros((1, 1, sending.shape[-1]))
    advantage = cast("Array", numpyro.deterministic("device_advantage", advantage))
    if successes is None:
        successes = _drawn(sending, deliveries, advantage)
    open_, log_odds = success_log_odds(advantage, sending, deliveries, jnp.asarray(successes))
    columns = {"open": open_ & valid[..., None], "log_odds": log_odds, "successes": successes}
    factor = Factor("success", "successes", ("log_odds",), _two_outcomes, ("device",), "open")
    draw_factors([factor], columns)


def _two_outcomes(columns: Columns) -> Array:
    return jnp.stack([jnp.zeros_like(columns["log_odds"]), columns["log_odds"]], axis=-1)


def success_log_odds(
    advantage: Float[Array, "#episode #slot device"],
    sending: Bool[Array, "episode slot device"],
    deliveries: Int[Array, "episode slot"],
    successes: Int[Array, "episode slot device"],
) -> tuple[Bool[Array, "episode slot device"], Float[Array, "episode slot device"]]:
    """Whether a device's fate is open given those before it, and its log-odds of being delivered.

    A set of senders is delivered with probability in proportion to the product of exp(advantage) over it, given its
    size: the conditional Bernoulli law (Chen and Liu, Statistica Sinica 7 (1997)), uniform without advantages.
    """
    weight = jnp.where(sending, jnp.exp(advantage), 0.0)
    total = deliveries[..., None] - jnp.cumsum(successes, axis=-1) + successes
    senders = jnp.cumsum(sending[..., ::-1], axis=-1)[..., ::-1]
    open_ = sending & (total > 0) & (total < senders)
    rest = _symmetric_polynomials(weight)
    left = jnp.where(open_, total, 1)
    with_it = weight * jnp.take_along_axis(rest, (left - 1)[..., None], axis=-1)[..., 0]
    without = jnp.take_along_axis(rest, left[..., None], axis=-1)[..., 0]
    log_odds = jnp.log(jnp.where(open_, with_it, 1.0)) - jnp.log(jnp.where(open_, without, 1.0))
    return open_, log_odds


def _symmetric_polynomials(
    weight: Float[Array, "episode slot device"],
) -> Float[Array, "episode slot device degree"]:
    """Elementary symmetric polynomials, of each degree, of the weights of the devices after each one."""
    devices = weight.shape[-1]
    one = jnp.zeros((*weight.shape[:-1], devices + 1)).at[..., 0].set(1.0)

    def add(rest: Array, own: Array) -> tuple[Array, Array]:
        shifted = jnp.concatenate([jnp.zeros_like(rest[..., :1]), rest[..., :-1]], axis=-1)
        return rest + own[..., None] * shifted, rest

    _, before = jax.lax.scan(add, one, jnp.moveaxis(weight, -1, 0), reverse=True)
    return jnp.moveaxis(before, 0, -2)


def _drawn(
    sending: Bool[Array, "episode slot device"],
    deliveries: Int[Array, "episode slot"],
    advantage: Float[Array, "#episode #slot device"],
) -> Int[Array, "episode slot device"]:
    """A draw of who is delivered; exact without advantages, by successive choice with them."""
    key = numpyro.prng_key()
    if key is None:
        return jnp.zeros(sending.shape, jnp.int32)
    rank = -(jax.random.gumbel(key, sending.shape) + advantage)
    rank = jnp.argsort(jnp.argsort(rank, axis=-1), axis=-1) / (2.0 * np.shape(sending)[-1])
    return jax.vmap(jax.vmap(lowest))(rank, sending, deliveries)
