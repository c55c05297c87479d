"""A multi-access network as it really is: clusters, buffers, traffic and multi-packet reception."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self, final

import numpy as np
from jaxtyping import Float

from dtprob.errors import InputError

type Clusters = tuple[tuple[int, ...], ...]

_TOLERANCE = 1e-6


@final
@dataclass(frozen=True, eq=False)
class Network:
    """Devices that share a slotted channel.

    Attributes:
        clusters: the devices of each cluster; every device from 0 is in exactly one.
        capacity: packets that a buffer holds.
        arrival: probability of each joint arrival of a cluster's devices given its last one,
            (cluster, previous, outcome). An outcome is a binary number, a digit per device, the first the
            most significant; rows of smaller clusters are padded with zeros. `previous` has size 1 for
            traffic without memory, else it counts like `outcome`.
        reception: probability of the number of deliveries given the number of senders,
            (senders 0..K, deliveries 0..K). Which senders succeed is uniform.
    """

    clusters: Clusters
    capacity: int
    arrival: Float[np.ndarray, "cluster previous outcome"]
    reception: Float[np.ndarray, "senders deliveries"]

    def __post_init__(self) -> None:
        """Refuse what is no network."""
        devices = sorted(device for cluster in self.clusters for device in cluster)
        if not devices or devices != list(range(len(devices))) or not all(self.clusters):
            remedy = "Put every device into exactly one cluster"
            raise InputError("clusters", "a partition of the devices 0, 1, ...", str(self.clusters), remedy)
        if self.capacity < 1:
            raise InputError(
                "capacity", "1 or more", str(self.capacity), "Give each buffer room for a packet"
            )
        outcomes = 2 ** max(len(cluster) for cluster in self.clusters)
        shapes = [(len(self.clusters), previous, outcomes) for previous in (1, outcomes)]
        if self.arrival.shape not in shapes:
            _refuse("shape of the arrivals", f"{shapes[0]} or {shapes[1]}", self.arrival.shape)
        if self.reception.shape != (self.devices + 1,) * 2:
            _refuse("shape of the reception", f"{(self.devices + 1,) * 2}", self.reception.shape)
        if np.any(np.triu(self.reception, 1) > 0):
            raise InputError(
                "reception", "no more deliveries than senders", "more", "Fill the lower triangle only"
            )
        for cluster, rows in zip(self.clusters, self.arrival, strict=True):
            size = 2 ** len(cluster)
            previous = min(size, len(rows))
            _check_rows(f"arrivals of cluster {cluster}", rows[:previous, :size])
            if np.any(rows[:previous, size:] > 0):
                raise InputError(
                    f"arrivals of cluster {cluster}", f"{size} outcomes", "more", "Pad its rows with zeros"
                )
        _check_rows("reception", self.reception)

    @property
    def devices(self) -> int:
        """Number of devices."""
        return sum(len(cluster) for cluster in self.clusters)

    @property
    def parameters(self) -> dict[str, Float[np.ndarray, "..."]]:
        """What a twin has to learn: `log_arrival` and `log_reception`, the logs of the tables."""
        with np.errstate(divide="ignore"):
            return {"log_arrival": np.log(self.arrival), "log_reception": np.log(self.reception)}

    def without(self, device: int) -> Self:
        """The same network with a device that generates no packets any more.

        Raises:
            InputError: no such device.
        """
        number = next((i for i, cluster in enumerate(self.clusters) if device in cluster), None)
        if number is None:
            expected = f"one of 0 to {self.devices - 1}"
            raise InputError("device", expected, str(device), "Name a device of the network")
        cluster = self.clusters[number]
        digit = 2 ** (len(cluster) - 1 - cluster.index(device))
        outcome = np.arange(self.arrival.shape[-1])
        arrival = self.arrival.copy()
        silent, with_it = arrival[number], (outcome & digit) > 0
        silent[:, outcome[with_it] - digit] += silent[:, with_it]
        silent[:, with_it] = 0.0
        return type(self)(self.clusters, self.capacity, arrival, self.reception)

    @classmethod
    def reference(cls) -> Self:
        """Four devices in two clusters, one packet each: the system of the seed report."""
        arrival = np.tile([0.2, 0.4, 0.4, 0.0], (2, 1, 1))
        return cls(((0, 1), (2, 3)), 1, arrival, reception([1.0], [0.8, 0.2], senders=4))

    @classmethod
    def pairs(cls, count: int, capacity: int = 1) -> Self:
        """`count` clusters of two devices with the reference arrivals; two packets at most get through."""
        arrival = np.tile([0.2, 0.4, 0.4, 0.0], (count, 1, 1))
        clusters = tuple((2 * number, 2 * number + 1) for number in range(count))
        return cls(clusters, capacity, arrival, reception([1.0], [0.8, 0.2], senders=2 * count))


def reception(*rows: Sequence[float], senders: int) -> Float[np.ndarray, "senders deliveries"]:
    """The reception matrix from the chances of 1, 2, ... deliveries for 1, 2, ... senders.

    Args:
        rows: for each number of senders from 1, the chance of 1, 2, ... deliveries; what is missing to one
            is that of none. More senders than there are rows lose every packet.
        senders: the most there can be.
    """
    table = np.zeros((senders + 1, senders + 1))
    for number, row in enumerate(rows[:senders], start=1):
        table[number, 1 : 1 + len(row)] = row
    table[:, 0] = 1 - table[:, 1:].sum(axis=1)
    return table


def _check_rows(what: str, rows: Float[np.ndarray, "row outcome"]) -> None:
    sums = rows.sum(axis=1)
    if np.any(rows < -_TOLERANCE) or np.any(np.abs(sums - 1) > _TOLERANCE):
        got = f"entries from {rows.min():.3g}, sums {sums.min():.6g} to {sums.max():.6g}"
        raise InputError(what, "rows of probabilities that sum to one", got, "Normalise every row")


def _refuse(what: str, expected: str, shape: tuple[int, ...]) -> None:
    raise InputError(what, expected, str(shape), "Lay the table out as the documentation of Network says")
