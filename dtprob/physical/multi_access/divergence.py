"""How much two logs tell of a fault: the divergence of their law from that of one network fitted to both, exactly.

A fault changes the traffic or the reception. Traffic with a fault is a Markov chain of joint arrivals. Where the traffic is
sound, the buffers are one, together with the fault's memory, which is kept on a grid.
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from math import comb
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import xlogy

from dtprob.physical.multi_access.fault import Fault, Past, subsets
from dtprob.physical.multi_access.log import sound_acks
from dtprob.physical.multi_access.network import Network

_MEMORIES: Final = 33
"""Values of a fault's memory that are told apart."""


class _Expected(NamedTuple):
    """What is expected of a log.

    Attributes:
        counts: how often each outcome occurs under each condition.
        certainty: sum over the slots of law times log(law), nats.
    """

    counts: Float[np.ndarray, "condition outcome"]
    certainty: float


def information(network: Network, fault: Fault, size: float, *, before: int, after: int) -> float:
    """Twice the divergence of the law of a sound log and one with a fault from that of the network fitted to both.

    The fitted network has one table of arrivals for each cluster and one of receptions, as the twin has, and each log
    begins with empty buffers.

    Args:
        network: the sound one, its traffic without memory.
        fault: which.
        size: of the fault.
        before: slots of the sound log.
        after: slots of the other.
    """
    total = 0.0
    if fault.arrivals is not None:
        sound = network.arrival[:, 0]
        seen = _traffic(network, fault, size, after)
        fitted = (before * sound + seen.counts) / (before + after)
        total += seen.certainty + before * xlogy(sound, sound).sum()
        total -= xlogy(before * sound + seen.counts, fitted).sum()
    if fault.acks is not None:
        logs = _sound_reception(network, before), _reception(network, fault, size, after)
        counts = logs[0].counts + logs[1].counts
        total += logs[0].certainty + logs[1].certainty - xlogy(counts, _fitted(network, counts)).sum()
    return float(2 * total)


def _fitted(
    network: Network, counts: Float[np.ndarray, "senders acked"]
) -> Float[np.ndarray, "senders acked"]:
    """The law of the sets that are acknowledged, from a table of their number by the number of senders."""
    devices = network.devices
    sizes = subsets(devices).sum(axis=1)
    table, place = np.zeros((devices + 1, devices + 1)), (sizes[:, None], sizes[None])
    np.add.at(table, place, counts)
    table /= np.maximum(table.sum(axis=1, keepdims=True), 1e-300)
    ways = np.array([[comb(n, d) for d in range(devices + 1)] for n in range(devices + 1)])
    return (table / np.maximum(ways, 1))[place]


def _traffic(network: Network, fault: Fault, size: float, slots: int) -> _Expected:
    """Joint arrivals of each cluster."""
    sets, sound = subsets(network.devices), network.arrival[:, 0]
    laws = np.stack(
        [
            [
                sound
                if fault.arrivals is None
                else fault.arrivals(sound, Past(slot, slot / slots, last), size)
                for last in sets
            ]
            for slot in range(min(fault.period or slots, slots))
        ]
    )
    moves = np.ones((*laws.shape[:2], len(sets)))
    for number, cluster in enumerate(network.clusters):
        outcome = sets[:, list(cluster)] @ 2 ** np.arange(len(cluster))[::-1]
        moves *= laws[:, :, number, outcome]
    visits = _visits(moves, np.eye(len(sets))[0], slots)
    certainty = np.sum(visits * xlogy(laws, laws).sum(axis=(2, 3)))
    return _Expected(np.einsum("pa,paco->co", visits, laws), float(certainty))


@lru_cache(maxsize=4)
def _sound_reception(network: Network, slots: int) -> _Expected:
    return _reception(network, Fault("sound", None), 0.0, slots)


def _reception(network: Network, fault: Fault, size: float, slots: int) -> _Expected:
    """Sets of devices that are acknowledged, by the set of senders."""
    sound, nowhere = sound_acks(network), np.zeros(network.devices, int)
    grid = np.zeros(1) if fault.follow is None else np.linspace(0, 1, _MEMORIES)
    laws = np.stack(
        [
            [
                sound
                if fault.acks is None
                else fault.acks(sound, Past(slot, slot / slots, nowhere, memory), size)
                for memory in grid
            ]
            for slot in range(min(fault.period or slots, slots))
        ]
    )
    remembered, (sends, fills) = _remembered(fault, size, sound, grid), _buffers(network)
    states = len(sends) * len(grid)
    moves = np.stack([_moves(law, remembered, sends, fills) for law in laws])
    start = np.outer(np.eye(len(sends))[0], _shares(np.array(fault.start(size)), grid))
    visits = _visits(moves.reshape(-1, states, states), start.reshape(-1), slots)
    senders = np.einsum("pbm,bs->pms", visits.reshape(len(laws), len(sends), len(grid)), sends)
    certainty = np.sum(senders * xlogy(laws, laws).sum(axis=3))
    return _Expected(np.einsum("pms,pmsd->sd", senders, laws), float(certainty))


def _buffers(
    network: Network,
) -> tuple[Float[np.ndarray, "buffer senders"], Float[np.ndarray, "buffer acked buffer"]]:
    """For each state of the buffers, the chance of each set of senders, and of each next state by who is acknowledged."""
    sets, levels = subsets(network.devices), network.capacity + 1
    states = np.array(list(itertools.product(range(levels), repeat=network.devices)))
    full, sizes = (states > 0).sum(axis=1), sets.sum(axis=1)
    inside = np.all(sets[None] <= states[:, None], axis=2)
    # Every device sends with the same chance, which is uniform from slot to slot.
    sends = np.array([[1 / ((n + 1) * max(comb(n, k), 1)) for k in sizes.tolist()] for n in full.tolist()])
    joint = np.ones(len(sets))
    for cluster, row in zip(network.clusters, network.arrival[:, 0], strict=True):
        joint *= row[sets[:, list(cluster)] @ 2 ** np.arange(len(cluster))[::-1]]
    after = np.clip(states[:, None, None] + sets[None, None] - sets[None, :, None], 0, network.capacity)
    number = after @ levels ** np.arange(network.devices)[::-1]
    fills = np.zeros((len(states), len(sets), len(states)))
    b, d, _ = np.indices(number.shape)
    np.add.at(fills, (b, d, number), np.broadcast_to(joint, number.shape))
    return np.where(inside, sends, 0.0), fills


def _remembered(
    fault: Fault, size: float, sound: Float[np.ndarray, "senders acked"], grid: Float[np.ndarray, " memory"]
) -> Float[np.ndarray, "memory senders acked memory"]:
    """The memory after a slot, shared among its two neighbours on the grid."""
    values = np.zeros((len(grid), *sound.shape))
    if fault.follow is not None:
        seen = sound > 0
        seen[:, 0] = True
        for (senders, acked), (m, memory) in itertools.product(np.argwhere(seen), enumerate(grid.tolist())):
            values[m, senders, acked] = fault.follow(memory, float(sound[senders, acked]), acked == 0, size)
    return _shares(values, grid)


def _shares(
    values: Float[np.ndarray, "*n"], grid: Float[np.ndarray, " memory"]
) -> Float[np.ndarray, "*n memory"]:
    """Weights of an evenly spaced grid from 0 to 1 whose mean is each value."""
    return np.maximum(1 - np.abs(values[..., None] - grid) * max(len(grid) - 1, 0), 0.0)


def _moves(
    law: Float[np.ndarray, "memory senders acked"],
    remembered: Float[np.ndarray, "memory senders acked memory"],
    sends: Float[np.ndarray, "buffer senders"],
    fills: Float[np.ndarray, "buffer acked buffer"],
) -> Float[np.ndarray, "buffer memory buffer memory"]:
    """Chance of each next state of buffers and memory."""
    seen = np.tensordot(sends, law[..., None] * remembered, axes=(1, 1))
    return np.swapaxes(np.swapaxes(seen, 2, 3) @ fills[:, None], 2, 3)


def _visits(
    moves: Float[np.ndarray, "phase state state"], start: Float[np.ndarray, " state"], slots: int
) -> Float[np.ndarray, "phase state"]:
    """How often each state is expected in each phase."""
    total, now = np.zeros(moves.shape[:2]), start
    for slot in range(slots):
        total[slot % len(moves)] += now
        now = now @ moves[slot % len(moves)]
    return total
