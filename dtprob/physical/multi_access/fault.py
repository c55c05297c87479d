"""A fault of a network: a change of the law of the next slot, given what was seen before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from dtprob.physical.multi_access.network import Network

type Rows = Float[np.ndarray, "cluster outcome"]
"""Probabilities of each cluster's joint arrivals in a slot."""
type Acks = Float[np.ndarray, "senders acked"]
"""For each set of senders the probability of each set that is acknowledged; sets are binary numbers, device 0 first."""


@dataclass(frozen=True)
class Past:
    """What a slot depends on.

    Attributes:
        slot: slots since the log began.
        share: of the log that is over.
        arrival: arrivals at the end of the last slot.
        memory: of the fault, see `Fault.follow`.
    """

    slot: int
    share: float
    arrival: Int[np.ndarray, " device"]
    memory: float = 0.0


@dataclass(frozen=True)
class Fault:
    """One fault, of the traffic or of the reception; its size is a probability or share, 0 is none.

    Attributes:
        family: name of the physics.
        instance: which device, pair or number of senders; None where there is only one.
        limit: largest size.
        period: slots after which its laws repeat; None where they change all along the log.
        arrivals: (rows, past, size) -> rows.
        acks: (acks, past, size) -> acks.
        start: memory before the first slot, by size.
        follow: (memory, chance that the acknowledged set had with all other faults, whether none was acknowledged, size)
            -> memory for the next slot. Faults with a memory act on `acks` after all others.
    """

    family: str
    instance: str | None
    limit: float = 0.95
    period: int | None = 1
    arrivals: Callable[[Rows, Past, float], Rows] | None = None
    acks: Callable[[Acks, Past, float], Acks] | None = None
    start: Callable[[float], float] = lambda _: 0.0
    follow: Callable[[float, float, bool, float], float] | None = None

    @property
    def name(self) -> str:
        """`family` or `family[instance]`."""
        return self.family if self.instance is None else f"{self.family}[{self.instance}]"


def subsets(devices: int) -> Int[np.ndarray, "subset device"]:
    """All sets of devices in the order of their binary numbers."""
    return (np.arange(2**devices)[:, None] >> np.arange(devices)[::-1]) & 1


def any_device(rng: np.random.Generator, network: Network) -> int:
    """One device at random."""
    return int(rng.integers(network.devices))
