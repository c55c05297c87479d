"""How well data about the reception can be collected at best, by dynamic programming.

One hand directs all devices, sees all buffers and knows the network; it plans how often each number of devices sends,
whatever comes out. What it could still gain by looking at the outcomes is little, since one row of the reference
network is random at all; devices that decide alone and do not know the network do worse.
"""

from math import comb
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.stats import binom

from dtprob.physical.multi_access import Network

_PAIRS: Final = tuple((first, second) for first in range(3) for second in range(3))
"""Of the two pairs, how many devices send, or how many buffers are full."""


def least_errors(network: Network, concentration: float, slots: int) -> Float[np.ndarray, " slot"]:
    """The least error of the reception table after 0, 1, ... slots from empty buffers, see `expected_errors`.

    Args:
        network: the reference network, or one with another reception.
        concentration: of the prior.
        slots: the most.
    """
    rows = [expected_errors(row[: n + 1], concentration, slots) for n, row in enumerate(network.reception)]
    visits = np.ix_(*(np.arange(slots + 1),) * 4)
    error = sum(row[seen] for row, seen in zip(rows[1:], visits, strict=True)) / 4
    value = np.repeat(np.asarray(error, np.float32)[..., None], len(_PAIRS), axis=-1)
    moves = [_move(network, senders) for senders in _PAIRS]
    found = [value[0, 0, 0, 0, 0]]
    for _ in range(slots):
        best = np.full_like(value, np.inf)
        for senders, move in zip(_PAIRS, moves, strict=True):
            after = _visited(value, sum(senders)) @ move.T
            np.minimum(best, np.where(move.any(axis=1), after, np.inf), out=best)
        value = best
        found.append(value[0, 0, 0, 0, 0])
    return np.array(found, float)


def expected_errors(
    row: Float[np.ndarray, " delivery"], concentration: float, visits: int
) -> Float[np.ndarray, " visit"]:
    """Total variation of the posterior mean from a row, expected after 0, 1, ... of its outcomes.

    Args:
        row: chances of the numbers of deliveries, of which one or two can be.
        concentration: of the prior.
        visits: the most.
    """
    first, last = np.flatnonzero(row)[[0, -1]]

    def one(count: int) -> float:
        seen = np.zeros((count + 1, len(row)))  # after 0, 1, ... outcomes of the last kind
        seen[:, first] += count - np.arange(count + 1)
        seen[:, last] += np.arange(count + 1)
        mean = (concentration + seen) / (concentration * len(row) + count)
        chance = binom.pmf(np.arange(count + 1), count, row[last] if last > first else 1.0)
        return float(chance @ np.abs(mean - row).sum(axis=1)) / 2

    return np.array([one(count) for count in range(visits + 1)])


def _visited(value: Float[np.ndarray, "a b c d full"], senders: int) -> Float[np.ndarray, "a b c d full"]:
    """The values after one more slot with some senders; the last place stands for more slots than there are."""
    if senders == 0:
        return value
    places = np.minimum(np.arange(value.shape[0]) + 1, value.shape[0] - 1)
    return np.take(value, places, axis=senders - 1)


def _move(network: Network, senders: tuple[int, int]) -> Float[np.ndarray, "full after"]:
    """Chances of the numbers of full buffers after a slot; a row of zeros where too few are full to send."""
    chances = np.zeros((len(_PAIRS),) * 2, np.float32)
    for before, full in enumerate(_PAIRS):
        if senders[0] > full[0] or senders[1] > full[1]:
            continue
        for gone in _PAIRS:
            chance = network.reception[sum(senders)][sum(gone)] * _shared(senders, gone)
            if chance > 0:
                left = (_filled(network, 0, full[0] - gone[0]), _filled(network, 1, full[1] - gone[1]))
                chances[before] += chance * np.outer(*left).ravel()
    return chances


def _shared(senders: tuple[int, int], gone: tuple[int, int]) -> float:
    """The chance that deliveries, drawn uniformly from the senders, fall on the two pairs like this."""
    ways = comb(senders[0], gone[0]) * comb(senders[1], gone[1])
    return ways / comb(sum(senders), sum(gone)) if ways else 0.0


def _filled(network: Network, pair: int, full: int) -> Float[np.ndarray, " full"]:
    """Chances of the numbers of full buffers of a pair after its arrivals, which come to one device at most."""
    chances = np.zeros(3)
    grows = network.arrival[pair, 0, 1] * (2 - full)
    chances[full] = 1 - grows
    if full < 2:
        chances[full + 1] = grows
    return chances
