"""How much two faults of a network look alike."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.physical.multi_access.fault import Fault, Past
from dtprob.physical.multi_access.log import sound_acks
from dtprob.physical.multi_access.network import Network

_MOMENTS: Final = 60
"""Moments of a log at which laws are compared."""
_RAREST: Final = 1e-3
"""Chance below which a sound network's outcomes all count as so rare."""


def likeness(network: Network, one: tuple[Fault, float], other: tuple[Fault, float]) -> float:
    """Size of the cosine between the changes that two faults make to the law of a slot, in standard deviations.

    Both laws are looked at with the same senders, each set of them as likely as any other, the same arrivals before, and
    the memory that the fault starts with.

    Args:
        network: the sound one.
        one: a fault with its size.
        other: another one.
    """
    a, b = (_seen(network, *each) for each in (one, other))
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return abs(float(a @ b)) / norm if norm > 0 else 0.0


def _seen(network: Network, fault: Fault, size: float) -> Float[np.ndarray, " entry"]:
    """What a fault changes at each moment of a log, over the square roots of what is expected."""
    rows, acks = network.arrival[:, 0], sound_acks(network)
    before = np.random.default_rng(0).integers(0, 2, (_MOMENTS, network.devices))
    parts = []
    for moment, arrival in enumerate(before):
        past = Past(moment, moment / _MOMENTS, arrival, fault.start(size))
        for sound, change, weight in ((rows, fault.arrivals, 1.0), (acks, fault.acks, len(acks) ** -0.5)):
            changed = change(sound, past, size) if change else sound
            parts.append((weight * (changed - sound) / np.sqrt(np.maximum(sound, _RAREST))).reshape(-1))
    return np.concatenate(parts)
