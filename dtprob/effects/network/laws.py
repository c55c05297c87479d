"""Ways to change a law given by logits that leave it exactly as it is at zero, and what a network's data say."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


class ClustersLike(Protocol):
    """What effects look at in the clusters of a network."""

    @property
    def members(self) -> tuple[tuple[int, ...], ...]:
        """Devices of each cluster."""
        ...

    @property
    def devices(self) -> int:
        """Number of devices."""
        ...

    @property
    def weight(self) -> Int[np.ndarray, "cluster device"]:
        """What each device's arrival adds to its cluster's outcome."""
        ...

    @property
    def cluster_of(self) -> Int[np.ndarray, " device"]:
        """The cluster of each device."""
        ...

    @property
    def arrives(self) -> Bool[np.ndarray, "cluster device outcome"]:
        """Whether an outcome of a cluster has an arrival at a device."""
        ...


def mix(
    logits: Float[Array, "*batch outcome"], other: Float[Array, "*batch outcome"], amount: Any
) -> Float[Array, "*batch outcome"]:
    """Logits of (1 - q) p + q other, where q = 1 - exp(-amount).

    Args:
        logits: of p, up to a constant.
        other: probabilities of the law that takes p's place.
        amount: 0 leaves p, infinity leaves `other`.
    """
    amount, log_p = jnp.asarray(amount), jax.nn.log_softmax(logits)
    is_there, is_mixed = other > 0, amount > 0
    log_other = jnp.log(jnp.where(is_there, other, 1.0))
    # In logs: unseen outcomes of a table may have a p far below the smallest number that can be divided by.
    some = jnp.where(is_mixed, amount, 1.0)
    log_mixed = jnp.logaddexp(log_p - some, log_other + jnp.log(-jnp.expm1(-some)))
    total = jax.nn.logsumexp(logits, axis=-1, keepdims=True)
    mixed = jnp.where(is_there, total + log_mixed, logits - some)
    # The logarithm of q has no derivative at 0. This form has, and is exact there; the ratio's square is finite.
    none = jnp.where(is_mixed, 0.0, amount)
    most = np.log(float(jnp.finfo(log_p.dtype).max)) / 2 - 1.0
    ratio = jnp.where(is_there, jnp.exp(jnp.minimum(log_other - log_p, most)), 0.0)
    kept = logits + jnp.log(jnp.exp(-none) - jnp.expm1(-none) * ratio)
    return jnp.where(is_mixed, mixed, kept)


def tilted(
    logits: Float[Array, "*batch outcome"], bit: int, log_odds: Float[Array, "*batch"] | Any
) -> Float[Array, "*batch outcome"]:
    """Logits of joint arrivals when the odds of one device's, given the others', change by a factor.

    The other devices go on as before: the law of their arrivals stays the same.

    Args:
        logits: of the joint arrivals, up to a constant.
        bit: binary digit of the device in the number of an outcome.
        log_odds: logarithm of the factor, broadcasting to the batch.
    """
    outcome = np.arange(logits.shape[-1])
    partner = logits[..., outcome ^ bit]
    is_there = jnp.maximum(logits, partner) > -jnp.inf
    here, there = (jnp.where(is_there, value, 0.0) for value in (logits, partner))
    up = jnp.asarray(log_odds)[..., None]
    own, other = jnp.where(outcome & bit, up, 0.0), jnp.where(outcome & bit, 0.0, up)
    change = own + jnp.logaddexp(here, there) - jnp.logaddexp(own + here, other + there)
    return logits + jnp.where(is_there, change, 0.0)


def thinned(logits: Float[Array, "*batch outcome"], bit: int) -> Float[Array, "*batch outcome"]:
    """Probabilities of joint arrivals when the device of a binary digit generates nothing."""
    p = jax.nn.softmax(logits)
    outcome = np.arange(p.shape[-1])
    return jnp.where(outcome & bit, 0.0, p + p[..., outcome ^ bit])


def joined(logits: Float[Array, "*batch outcome"], bit: int) -> Float[Array, "*batch outcome"]:
    """Probabilities of joint arrivals when the device of a binary digit generates a packet in every slot."""
    p = jax.nn.softmax(logits)
    outcome = np.arange(p.shape[-1])
    return jnp.where(outcome & bit, p + p[..., outcome ^ bit], 0.0)


def repeated(
    logits: Float[Array, "*batch outcome"], bit: int, last: Float[Array, "*batch"]
) -> Float[Array, "*batch outcome"]:
    """Probabilities of joint arrivals when the device of a binary digit does what it did last, 1 for a packet."""
    return jnp.where(last[..., None] > 0, joined(logits, bit), thinned(logits, bit))


def clusters_of(data: Mapping[str, Any]) -> ClustersLike | None:
    """The clusters of a network's data, None where these are other data."""
    found = data.get("clusters")
    return found if hasattr(found, "arrives") else None


def at(index: int, size: int) -> Bool[np.ndarray, " n"]:
    """True at one place of a vector."""
    return np.arange(size) == index


def in_cluster_of(
    logits: Float[Array, "*batch cluster outcome"],
    clusters: ClustersLike,
    device: int,
    change: Callable[[Float[Array, "*batch cluster outcome"], int], Float[Array, "*batch cluster outcome"]],
) -> Float[Array, "*batch cluster outcome"]:
    """Logits of all clusters' arrivals, changed in the one that a device belongs to.

    Args:
        logits: of the joint arrivals of each cluster.
        clusters: of the network.
        device: whose cluster changes.
        change: logits and the binary digit of the device in the number of an outcome -> new logits.
    """
    cluster = int(clusters.cluster_of[device])
    changed = change(logits, int(clusters.weight[cluster, device]))
    return jnp.where(at(cluster, logits.shape[-2])[:, None], changed, logits)


def mixed_at(
    logits: Float[Array, "*batch cluster outcome"],
    clusters: ClustersLike,
    device: int,
    change: Callable[[Float[Array, "*batch cluster outcome"], int], Float[Array, "*batch cluster outcome"]],
    amount: Any,
) -> Float[Array, "*batch cluster outcome"]:
    """Logits of all clusters' arrivals, `mix`ed with another law in the one that a device belongs to.

    Args:
        logits: of the joint arrivals of each cluster.
        clusters: of the network.
        device: whose cluster changes.
        change: logits and the binary digit of the device -> probabilities of the other law.
        amount: what `mix` takes, broadcasting to the logits.
    """
    return in_cluster_of(logits, clusters, device, lambda value, bit: mix(value, change(value, bit), amount))


def of_device(
    logits: Float[Array, "*batch cluster outcome"], clusters: ClustersLike, device: int, log_odds: Any
) -> Float[Array, "*batch cluster outcome"]:
    """Logits of all clusters' arrivals, `tilted` in the one that a device belongs to.

    Args:
        logits: of the joint arrivals of each cluster.
        clusters: of the network.
        device: whose odds change.
        log_odds: logarithm of the factor, broadcasting to (*batch, cluster).
    """
    return in_cluster_of(logits, clusters, device, lambda value, bit: tilted(value, bit, log_odds))


def last_arrival(
    data: Mapping[str, Any], clusters: ClustersLike, device: int
) -> Float[Array, "episode slot"]:
    """1 where the device had an arrival at the end of the slot before, else 0."""
    return _has(data["previous"], clusters, device)


def last_delivery(
    data: Mapping[str, Any], clusters: ClustersLike, device: int
) -> Float[Array, "episode slot"]:
    """1 where a packet of the device was delivered in the slot before, else 0."""
    return _has(data["acknowledged"], clusters, device)


def same_arrival(
    data: Mapping[str, Any], clusters: ClustersLike, device: int
) -> Float[Array, "episode slot"]:
    """1 where the device has an arrival at the end of this slot, else 0."""
    return _has(data["arrivals"], clusters, device)


def _has(joint: Any, clusters: ClustersLike, device: int) -> Float[Array, "episode slot"]:
    cluster = int(clusters.cluster_of[device])
    bit = int(clusters.weight[cluster, device])
    return jnp.where(jnp.asarray(joint)[..., cluster] & bit, 1.0, 0.0)


def progress(windows: int) -> Float[np.ndarray, "window 1"]:
    """Place of each window in the log, 0 at its start and 1 at its end."""
    return np.linspace(0.0, 1.0, windows)[:, None]


def from_then_on(amount: Any, windows: int, onset: Any) -> Float[Array, " window"]:
    """What `mix` takes in each window for an amount that sets in after a share of the log.

    The edge is soft over one window, in what is mixed and not in the amount, so that the time has a derivative and a large
    amount does not begin earlier.
    """
    place = (np.arange(windows) + 0.5) / windows
    after = (place - onset) * windows
    # One form is exactly 0 at amount 0, the other keeps a large amount finite.
    is_small = jnp.asarray(amount) < 1.0
    small, large = jnp.where(is_small, amount, 0.0), jnp.where(is_small, 1.0, amount)
    return jnp.where(
        is_small,
        -jnp.log1p(jax.nn.sigmoid(after) * jnp.expm1(-small)),
        -jnp.logaddexp(jax.nn.log_sigmoid(-after), jax.nn.log_sigmoid(after) - large),
    )
