"""Logs of a network, with faults or without."""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import numpy as np
from jaxtyping import Float

from dtprob.data.kinds import NetworkLog
from dtprob.physical.multi_access.fault import Acks, Fault, Past, Rows, subsets
from dtprob.physical.multi_access.network import Network


def record(
    seed: Sequence[int], network: Network, slots: int, faults: Sequence[tuple[Fault, float]] = ()
) -> NetworkLog:
    """One episode from empty buffers under random access, the chance of sending drawn anew in every slot.

    Args:
        seed: of all draws; the same ones whatever the faults.
        network: traffic without memory.
        slots: length of the episode.
        faults: each with its size; they act in this order, those with a memory last.
    """
    faults = sorted(faults, key=lambda one: one[0].follow is not None)
    uniform = np.random.default_rng(list(seed)).random((slots, network.devices + len(network.clusters) + 2))
    sets, sound = subsets(network.devices), sound_acks(network)
    place = 2 ** np.arange(network.devices)[::-1]
    buffer, arrival = np.zeros(network.devices, int), np.zeros(network.devices, int)
    memories = [fault.start(size) for fault, size in faults]
    columns: list[tuple[np.ndarray, ...]] = []
    for slot in range(slots):
        u = uniform[slot]
        action = (u[1 : 1 + network.devices] < u[0]).astype(int)
        senders = int((action * (buffer > 0)) @ place)
        pasts = [Past(slot, slot / slots, arrival, memory) for memory in memories]
        rows, acks = _laws(network, sound, list(zip(faults, pasts, strict=True)))
        acked = _inverse(acks[senders], u[1 + network.devices])
        for number, (fault, size) in enumerate(faults):
            if fault.follow is not None:
                others = [each for k, each in enumerate(zip(faults, pasts, strict=True)) if k != number]
                chance = float(_laws(network, sound, others)[1][senders, acked])
                memories[number] = fault.follow(memories[number], chance, acked == 0, size)
        arrival = _joint(
            network, [_inverse(row, v) for row, v in zip(rows, u[2 + network.devices :], strict=True)]
        )
        ack = sets[acked]
        columns.append((buffer, action, ack, arrival))
        buffer = np.clip(buffer + arrival - ack, 0, network.capacity)
    names = ("buffer", "action", "ack", "arrival")
    arrays = {name: np.stack(column) for name, column in zip(names, zip(*columns, strict=True), strict=True)}
    return NetworkLog(episode=np.zeros(slots, int), slot=np.arange(slots), **arrays)


def _laws(
    network: Network, sound: Acks, faults: Sequence[tuple[tuple[Fault, float], Past]]
) -> tuple[Rows, Acks]:
    """The laws of a slot with faults, each with its size and its past."""
    rows, acks = network.arrival[:, 0], sound
    for (fault, size), past in faults:
        rows = fault.arrivals(rows, past, size) if fault.arrivals else rows
        acks = fault.acks(acks, past, size) if fault.acks else acks
    return rows, acks


def sound_acks(network: Network) -> Acks:
    """Chances of the sets that are acknowledged: each set of the right size among the senders is as likely as any other."""
    sets = subsets(network.devices)
    sizes = sets.sum(axis=1)
    inside = np.all(sets[None] <= sets[:, None], axis=2)
    ways = np.array([[comb(int(n), int(d)) for d in sizes] for n in sizes])
    return np.where(inside, network.reception[sizes[:, None], sizes[None]] / np.maximum(ways, 1), 0.0)


def _inverse(law: Float[np.ndarray, " outcome"], uniform: float) -> int:
    cumulative = np.cumsum(law)
    return int(np.searchsorted(cumulative / cumulative[-1], uniform, side="right"))


def _joint(network: Network, outcomes: Sequence[int]) -> np.ndarray:
    arrival = np.zeros(network.devices, int)
    for cluster, outcome in zip(network.clusters, outcomes, strict=True):
        for position, device in enumerate(reversed(cluster)):
            arrival[device] = (outcome >> position) & 1
    return arrival
