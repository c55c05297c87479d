"""Ways to change a law given by logits that leave it exactly as it is at zero, and what a network's data say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

_LEAST = 1e-30


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
    p = jax.nn.softmax(logits)
    return logits + jnp.log(jnp.exp(-amount) - jnp.expm1(-amount) * other / jnp.maximum(p, _LEAST))


def thinned(logits: Float[Array, "*batch outcome"], bit: int) -> Float[Array, "*batch outcome"]:
    """Probabilities of joint arrivals when the device of a binary digit generates nothing."""
    p = jax.nn.softmax(logits)
    outcome = np.arange(p.shape[-1])
    return jnp.where(outcome & bit, 0.0, p + p[..., outcome ^ bit])


def clusters_of(data: Mapping[str, Any]) -> ClustersLike | None:
    """The clusters of a network's data, None where these are other data."""
    found = data.get("clusters")
    return found if hasattr(found, "arrives") else None


def at(index: int, size: int) -> Bool[np.ndarray, " n"]:
    """True at one place of a vector."""
    return np.arange(size) == index


def last_arrival(
    data: Mapping[str, Any], clusters: ClustersLike, device: int
) -> Float[Array, "episode slot"]:
    """1/2 where the device had an arrival at the end of the slot before, else -1/2."""
    return _centred(data["previous"], clusters, device)


def same_arrival(
    data: Mapping[str, Any], clusters: ClustersLike, device: int
) -> Float[Array, "episode slot"]:
    """1/2 where the device has an arrival at the end of this slot, else -1/2."""
    return _centred(data["arrivals"], clusters, device)


def _centred(joint: Any, clusters: ClustersLike, device: int) -> Float[Array, "episode slot"]:
    cluster = int(clusters.cluster_of[device])
    bit = int(clusters.weight[cluster, device])
    return jnp.where(jnp.asarray(joint)[..., cluster] & bit, 0.5, -0.5)


def progress(windows: int) -> Float[np.ndarray, "window 1"]:
    """Place of each window in the log, -1 at its start and 1 at its end."""
    return np.linspace(-1.0, 1.0, windows)[:, None]
