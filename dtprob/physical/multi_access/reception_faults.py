"""Faults of the channel: packets that are heard less, more, or otherwise than they were."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from dtprob.physical.multi_access.fault import Acks, Fault, Past, any_device, subsets
from dtprob.physical.multi_access.network import Network

_BURST: Final = 8.0
"""Mean length of an outage, slots."""
_ON, _CYCLE = 10, 20


def _silenced(acks: Acks, chosen: np.ndarray, share: float) -> Acks:
    """Nothing is acknowledged in a share of the slots with these sets of senders."""
    acks = acks.copy()
    acks[chosen] *= 1 - share
    acks[chosen, 0] += share
    return acks


def _shadowed(rng: np.random.Generator, network: Network) -> Fault:
    heard = [n for n in range(1, network.devices + 1) if network.reception[n, 0] < 0.9]
    count = int(rng.choice(heard))
    chosen = subsets(network.devices).sum(axis=1) == count
    return Fault(
        "reception_shift", f"{count}_senders", acks=lambda acks, _, size: _silenced(acks, chosen, size)
    )


def _capture(_rng: np.random.Generator, network: Network) -> Fault:
    """In Rayleigh fading one of n is heard over the others with probability n s^(n-1), s = 1 / (1 + threshold)."""
    sets = subsets(network.devices)
    single = 2 ** np.arange(network.devices)[::-1]

    def win(acks: Acks, _: Past, size: float) -> Acks:
        acks = acks.copy()
        for senders in np.flatnonzero(sets.sum(axis=1) > 1):
            n = sets[senders].sum()
            taken = acks[senders, 0] * min(1.0, n * size ** (n - 1))
            acks[senders, 0] -= taken
            acks[senders, single[sets[senders] > 0]] += taken / n
        return acks

    return Fault("capture", None, 0.5, acks=win)


def _near_far(rng: np.random.Generator, network: Network) -> Fault:
    device, sets = any_device(rng, network), subsets(network.devices)
    sizes = sets.sum(axis=1)

    def favour(acks: Acks, _: Past, size: float) -> Acks:
        weighed = acks * np.where(sets[:, device] > 0, 1 / (1 - size), 1.0)
        for count in range(1, network.devices + 1):
            of_size = sizes == count
            before, after = acks[:, of_size].sum(axis=1), weighed[:, of_size].sum(axis=1)
            weighed[:, of_size] *= np.divide(before, after, out=np.zeros_like(before), where=after > 0)[
                :, None
            ]
        return weighed

    return Fault("near_far", f"device_{device}", acks=favour)


def _ack_loss(rng: np.random.Generator, network: Network) -> Fault:
    device = any_device(rng, network)
    acked = np.flatnonzero(subsets(network.devices)[:, device])
    bit = 2 ** (network.devices - 1 - device)

    def lose(acks: Acks, _: Past, size: float) -> Acks:
        acks = acks.copy()
        acks[:, acked - bit] += size * acks[:, acked]
        acks[:, acked] *= 1 - size
        return acks

    return Fault("ack_loss", f"device_{device}", acks=lose)


def _duty_cycle(rng: np.random.Generator, network: Network) -> Fault:
    device = any_device(rng, network)
    sending = np.flatnonzero(subsets(network.devices)[:, device])
    bit = 2 ** (network.devices - 1 - device)

    def sleep(acks: Acks, _: Past, size: float) -> Acks:
        acks = acks.copy()
        acks[sending] = (1 - size) * acks[sending] + size * acks[sending - bit]
        return acks

    return Fault("duty_cycle", f"device_{device}", acks=sleep)


def _interferer(_rng: np.random.Generator, network: Network) -> Fault:
    """A stranger that sends in bouts: in half of each cycle, with a probability."""
    sets = subsets(network.devices)
    sizes = sets.sum(axis=1)
    inside = np.all(sets[None] <= sets[:, None], axis=2)
    sets_of = np.stack([np.sum(inside & (sizes == d), axis=1) for d in range(network.devices + 1)], axis=1)

    def disturb(acks: Acks, past: Past, size: float) -> Acks:
        if past.slot % _CYCLE >= _ON:
            return acks
        disturbed = np.zeros_like(acks)
        for senders, n in enumerate(sizes):
            law = network.reception[min(n + 1, network.devices)]
            for d in range(n + 2):
                chance = law[d] if d < len(law) else 0.0
                for own, share in ((d, 1 - d / (n + 1)), (d - 1, d / (n + 1))):
                    if share > 0 and 0 <= own <= n:
                        chosen = inside[senders] & (sizes == own)
                        disturbed[senders, chosen] += chance * share / sets_of[senders, own]
        return (1 - size) * acks + size * disturbed

    return Fault("interferer", None, period=_CYCLE, acks=disturb)


def _bursty_channel(_rng: np.random.Generator, network: Network) -> Fault:
    """Gilbert and Elliott: nothing is heard in outages; the memory is the chance of one, given what was heard."""
    every = np.ones(2**network.devices, bool)

    def follow(bad: float, chance: float, silent: bool, size: float) -> float:
        after = bad * silent / max(bad * silent + (1 - bad) * chance, 1e-300)
        return after * (1 - 1 / _BURST) + (1 - after) * size / (1 - size) / _BURST

    return Fault(
        "bursty_channel",
        None,
        0.8,
        acks=lambda acks, past, _: _silenced(acks, every, past.memory),
        start=lambda size: size,
        follow=follow,
    )


def _pair_interference(rng: np.random.Generator, network: Network) -> Fault:
    first, second = sorted(map(int, rng.choice(network.devices, 2, replace=False)))
    sets = subsets(network.devices)
    chosen = (sets[:, first] & sets[:, second]) > 0
    return Fault(
        "pair_interference",
        f"{first}_{second}",
        acks=lambda acks, _, size: _silenced(acks, chosen, size),
    )


FAMILIES: Final[dict[str, Callable[[np.random.Generator, Network], Fault]]] = {
    "reception_shift": _shadowed,
    "capture": _capture,
    "near_far": _near_far,
    "ack_loss": _ack_loss,
    "duty_cycle": _duty_cycle,
    "interferer": _interferer,
    "bursty_channel": _bursty_channel,
    "pair_interference": _pair_interference,
}
