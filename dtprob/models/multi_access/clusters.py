"""Joint arrivals of a cluster as one number, and which entries of the model's tables can happen."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from typing import final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from dtprob.errors import InputError

_LARGEST = 12


@final
@dataclass(frozen=True)
class Clusters:
    """How the devices of a network form clusters whose arrivals are drawn together.

    An outcome is the binary number of the arrivals of a cluster's devices, the first device most significant.

    Attributes:
        members: the devices of each cluster.

    Raises:
        InputError: devices that are not numbered from 0, each in one cluster, or a cluster of more than 12.
    """

    members: tuple[Sequence[int], ...]

    def __post_init__(self) -> None:
        """Check that the clusters are a partition of the devices."""
        if not all(isinstance(c, Iterable) for c in self.members):
            remedy = "Write a list of devices for each cluster, as in [[0, 1], [2, 3]]"
            raise InputError("clusters", "lists of devices' numbers", str(list(self.members)), remedy)
        if any(isinstance(d, bool) or not isinstance(d, Integral) for c in self.members for d in c):
            got = str([list(c) for c in self.members])
            raise InputError("clusters", "lists of devices' numbers", got, "Correct the value")
        object.__setattr__(self, "members", tuple(tuple(map(int, c)) for c in self.members))
        listed = sorted(device for cluster in self.members for device in cluster)
        if not listed or listed != list(range(len(listed))) or not all(self.members):
            remedy = "Put every device from 0 into one cluster, as in [[0, 1], [2, 3]]"
            raise InputError("clusters", "each device once", str([list(c) for c in self.members]), remedy)
        if self.largest > _LARGEST:
            remedy = "Split the cluster; its joint arrivals have two to the power of its size outcomes"
            raise InputError("clusters", f"at most {_LARGEST} devices each", str(self.largest), remedy)

    @property
    def devices(self) -> int:
        """Number of devices."""
        return sum(map(len, self.members))

    @property
    def largest(self) -> int:
        """Number of devices of the largest cluster."""
        return max(map(len, self.members))

    @property
    def count(self) -> int:
        """Number of joint arrivals of the largest cluster."""
        return 2**self.largest

    @cached_property
    def weight(self) -> Int[np.ndarray, "cluster device"]:
        """What each device's arrival adds to its cluster's outcome; 0 in other clusters."""
        weight = np.zeros((len(self.members), self.devices), dtype=np.int32)
        for row, cluster in enumerate(self.members):
            weight[row, list(cluster)] = 2 ** np.arange(len(cluster))[::-1]
        return weight

    @cached_property
    def cluster_of(self) -> Int[np.ndarray, " device"]:
        """The cluster of each device; 32 bits, so that it is the same index in either precision of JAX."""
        return np.argmax(self.weight > 0, axis=0).astype(np.int32)

    @cached_property
    def arrives(self) -> Bool[np.ndarray, "cluster device outcome"]:
        """Whether an outcome of a cluster has an arrival at a device."""
        return (self.weight[..., None] & np.arange(self.count)) > 0

    def encode(self, arrival: Int[Array, "*batch device"]) -> Int[Array, "*batch cluster"]:
        """The outcome of each cluster from the arrivals of all devices."""
        return jnp.asarray(arrival) @ jnp.asarray(self.weight.T)

    def decode(self, outcome: Int[Array, "*batch cluster"]) -> Int[Array, "*batch device"]:
        """The arrivals of all devices from the outcome of each cluster."""
        own = self.weight.max(axis=0)
        return ((jnp.asarray(outcome)[..., self.cluster_of] & own) > 0).astype(jnp.int32)

    def arrival_allowed(self, *, memory: bool) -> Bool[np.ndarray, "cluster previous outcome"]:
        """Which joint arrivals a cluster has; rows that no last arrival can name have the first only.

        Args:
            memory: whether arrivals depend on the cluster's last ones.
        """
        own = np.arange(self.count) < 2 ** np.array([[len(c)] for c in self.members])
        if not memory:
            return own[:, None, :]
        allowed = own[:, :, None] & own[:, None, :]
        allowed[..., 0] = True
        return allowed

    def reception_allowed(self) -> Bool[np.ndarray, "sender_count delivery_count"]:
        """Which numbers of deliveries a number of senders can have: no more than senders."""
        count = np.arange(self.devices + 1)
        return count <= count[:, None]
