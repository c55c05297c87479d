"""Faults of the traffic: devices that generate packets less, more, or otherwise than they did."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from jaxtyping import Int

from dtprob.physical.multi_access.fault import Fault, Past, Rows, any_device
from dtprob.physical.multi_access.network import Network

_PERIOD: Final = 7


def _place(network: Network, device: int) -> tuple[int, Int[np.ndarray, " outcome"]]:
    """A device's cluster, and for each of its outcomes whether the device has an arrival."""
    for number, cluster in enumerate(network.clusters):
        if device in cluster:
            return number, (np.arange(2 ** len(cluster)) >> (len(cluster) - 1 - cluster.index(device))) & 1
    raise AssertionError(device)


def _generate(network: Network, device: int) -> Callable[[Rows, float], Rows]:
    """(rows, share) -> rows in which a packet is generated with this probability where there was none."""
    cluster, has = _place(network, device)
    step = int(np.flatnonzero(has)[0])

    def add(rows: Rows, share: float) -> Rows:
        rows, without = rows.copy(), np.flatnonzero(has == 0)
        rows[cluster, without + step] += share * rows[cluster, without]
        rows[cluster, without] *= 1 - share
        return rows

    return add


def _disconnected(rng: np.random.Generator, network: Network) -> Fault:
    device = any_device(rng, network)
    cluster, has = _place(network, device)
    step = int(np.flatnonzero(has)[0])

    def silence(rows: Rows, past: Past, size: float) -> Rows:
        if past.share < 1 - size:
            return rows
        rows, with_ = rows.copy(), np.flatnonzero(has)
        rows[cluster, with_ - step] += rows[cluster, with_]
        rows[cluster, with_] = 0.0
        return rows

    return Fault("device_disconnected", f"device_{device}", 1.0, period=None, arrivals=silence)


def _rate(rng: np.random.Generator, network: Network) -> Fault:
    device = any_device(rng, network)
    add = _generate(network, device)
    return Fault("arrival_rate_shift", f"device_{device}", arrivals=lambda rows, _, size: add(rows, size))


def _drift(rng: np.random.Generator, network: Network) -> Fault:
    device = any_device(rng, network)
    add = _generate(network, device)
    return Fault(
        "drift",
        f"device_{device}",
        period=None,
        arrivals=lambda rows, past, size: add(rows, size * past.share),
    )


def _periodic(rng: np.random.Generator, network: Network) -> Fault:
    device = any_device(rng, network)
    add = _generate(network, device)

    def tick(rows: Rows, past: Past, size: float) -> Rows:
        return add(rows, size) if past.slot % _PERIOD == 0 else rows

    return Fault("periodic_traffic", f"device_{device}", period=_PERIOD, arrivals=tick)


def _bursty_traffic(rng: np.random.Generator, network: Network) -> Fault:
    device = any_device(rng, network)
    cluster, has = _place(network, device)
    step = int(np.flatnonzero(has)[0])

    def repeat(rows: Rows, past: Past, size: float) -> Rows:
        rows, without = rows.copy(), np.flatnonzero(has == 0)
        others = rows[cluster, without] + rows[cluster, without + step]
        rows[cluster] *= 1 - size
        rows[cluster, without + step * past.arrival[device]] += size * others
        return rows

    return Fault("bursty_traffic", f"device_{device}", arrivals=repeat)


def _cross(rng: np.random.Generator, network: Network) -> Fault:
    first, second = rng.choice(len(network.clusters), 2, replace=False)
    cause, device = (int(rng.choice(network.clusters[number])) for number in (first, second))
    add = _generate(network, device)

    def forward(rows: Rows, past: Past, size: float) -> Rows:
        return add(rows, size) if past.arrival[cause] else rows

    return Fault("cross_cluster_traffic", f"{cause}_to_{device}", arrivals=forward)


FAMILIES: Final[dict[str, Callable[[np.random.Generator, Network], Fault]]] = {
    "device_disconnected": _disconnected,
    "arrival_rate_shift": _rate,
    "bursty_traffic": _bursty_traffic,
    "cross_cluster_traffic": _cross,
    "drift": _drift,
    "periodic_traffic": _periodic,
}
