"""Small networks as finite Markov chains: all states that can occur, and where each slot leads, exactly."""

import itertools
from dataclasses import dataclass
from math import comb
from typing import Final, final

import numpy as np
from jaxtyping import Float, Int

from dtprob.errors import InputError
from dtprob.physical.multi_access.network import Network

MOST_STATES: Final = 6000
"""Larger chains would take gigabytes."""


@final
@dataclass(frozen=True, eq=False)
class Chain:
    """The states that the empty network can come to, and the law of the next one.

    A slot is a set of senders, a set of deliveries among them and a joint arrival; sets and arrivals are
    rows of `subsets`.

    Attributes:
        network: whose chain this is.
        buffer, arrival, ack: of each state; the first state is the empty network.
        subsets: all sets of devices, as rows of zeros and ones.
        success: chance of each set of deliveries given the set of senders.
        arrivals: chance of each joint arrival.
        following: number of the next state.
    """

    network: Network
    buffer: Int[np.ndarray, "state device"]
    arrival: Int[np.ndarray, "state device"]
    ack: Int[np.ndarray, "state device"]
    subsets: Int[np.ndarray, "subset device"]
    success: Float[np.ndarray, "senders subset"]
    arrivals: Float[np.ndarray, "state subset"]
    following: Int[np.ndarray, "state subset subset"]

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.buffer)


def chain(network: Network, *, remembers_ack: bool = True) -> Chain:
    """Enumerate a network.

    Args:
        network: a small one.
        remembers_ack: whether a state knows who was acknowledged last, which policies may ask and the
            network itself does not need. Without it states are fewer, and all acknowledgements read 0.

    Raises:
        InputError: more states than fit into memory.
    """
    devices = network.devices
    if devices > 8:
        raise _too_many(f"{devices} devices")
    subsets = np.array(list(itertools.product((0, 1), repeat=devices)))
    success = _success(network, subsets)
    law = np.stack([_joint_arrival(network, last, subsets) for last in subsets])
    remembers_arrival = remembers_ack or network.arrival.shape[1] > 1
    known: dict[tuple[int, ...], int] = {(0,) * (3 * devices): 0}
    rows = [np.zeros(3 * devices, int)]
    following: list[np.ndarray] = []
    while len(following) < len(rows):
        state = rows[len(following)]
        following.append(np.full((len(subsets), len(subsets)), -1))
        buffer, last = state[:devices], state[devices : 2 * devices]
        deliveries = np.flatnonzero(np.all(subsets <= buffer, axis=1) & (success.max(axis=0) > 0))
        joint = np.flatnonzero(law[_number(last)] > 0)
        for d, a in itertools.product(deliveries, joint):
            after = np.clip(buffer + subsets[a] - subsets[d], 0, network.capacity)
            row = np.concatenate([after, subsets[a] * remembers_arrival, subsets[d] * remembers_ack])
            code = tuple(row.tolist())
            if code not in known:
                known[code] = len(rows)
                rows.append(row)
            following[-1][d, a] = known[code]
        if len(rows) > MOST_STATES:
            raise _too_many(f"more than {MOST_STATES}")
    table = np.array(rows)
    buffer, arrival, ack = (table[:, i * devices : (i + 1) * devices] for i in range(3))
    arrivals = law[[_number(last) for last in arrival]]
    return Chain(network, buffer, arrival, ack, subsets, success, arrivals, np.array(following))


def _number(digits: Int[np.ndarray, " device"]) -> int:
    return int("".join(str(digit) for digit in digits), 2)


def _success(network: Network, subsets: np.ndarray) -> Float[np.ndarray, "senders subset"]:
    sizes = subsets.sum(axis=1)
    table = np.zeros((len(subsets), len(subsets)))
    for m, d in itertools.product(range(len(subsets)), repeat=2):
        if np.all(subsets[d] <= subsets[m]):
            table[m, d] = network.reception[sizes[m], sizes[d]] / comb(int(sizes[m]), int(sizes[d]))
    return table


def _joint_arrival(network: Network, last: np.ndarray, subsets: np.ndarray) -> Float[np.ndarray, " subset"]:
    """Chance of each joint arrival of all devices given the last one: a product over clusters."""
    law = np.ones(len(subsets))
    for cluster, rows in zip(network.clusters, network.arrival, strict=True):
        members = list(cluster)
        row = rows[_number(last[members]) if len(rows) > 1 else 0]
        law *= row[[_number(subset[members]) for subset in subsets]]
    return law


def _too_many(got: str) -> InputError:
    remedy = "Simulate it, or take fewer devices or smaller buffers"
    return InputError("exact solution", f"a network of at most {MOST_STATES} states", got, remedy)
