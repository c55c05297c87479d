"""Exact long-run averages of a network: under a given local rule, and under the best central control."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dtprob.errors import DtprobError, InputError
from dtprob.physical.multi_access.chain import Chain
from dtprob.physical.multi_access.kernel import REWARDS

type Rule = Float[np.ndarray, "phase device buffer arrival ack"]
"""Chance that a device with a packet sends, by what it sees; `phase` is the slot modulo the frame."""

_TOLERANCE = 1e-10


class Averages(NamedTuple):
    """What a network does in the long run.

    Attributes:
        throughput: packets delivered per slot.
        overflow: packets lost per device and slot.
        reward: per slot, as `Rewards` pays by default.
    """

    throughput: float
    overflow: float
    reward: float


class Solution(NamedTuple):
    """The best central control.

    Attributes:
        averages: what it achieves.
        senders: for each state of the chain, the number of the best set of senders in `Chain.subsets`.
    """

    averages: Averages
    senders: Int[np.ndarray, " state"]


class Gains(NamedTuple):
    """What one slot gives on average, by state and set of deliveries.

    Attributes:
        delivered: packets that get through.
        overflow: packets lost, per device.
        reward: of the slot.
    """

    delivered: Float[np.ndarray, "state subset"]
    overflow: Float[np.ndarray, "state subset"]
    reward: Float[np.ndarray, "state subset"]


def gains(chain: Chain) -> Gains:
    """See `Gains`."""
    subsets, devices = chain.subsets, chain.network.devices
    fills = chain.arrivals @ subsets  # chance of an arrival, (state, device)
    lost = (chain.buffer == chain.network.capacity) * fills
    overflow = lost @ (1 - subsets).T
    delivered = np.broadcast_to(subsets.sum(axis=1), overflow.shape).astype(float)
    rest = devices - delivered - overflow
    reward = REWARDS.delivered * delivered + REWARDS.overflow * overflow + REWARDS.otherwise * rest
    return Gains(delivered, overflow / devices, reward)


def average(chain: Chain, rule: Rule) -> Averages:
    """Long-run averages when every device follows a rule of its own.

    Args:
        chain: that knows the last acknowledgements, see `dtprob.physical.multi_access.chain.chain`.
        rule: chances of sending; those of an empty buffer do not matter.

    Raises:
        InputError: the rule's shape does not fit the network.
    """
    outcome = [deliveries(chain, senders(chain, phase)) for phase in check_rule(chain, rule)]
    occupied = stationary([transition(chain, each) for each in outcome])
    each = gains(chain)
    sums = (
        np.mean([np.sum(mu[:, None] * d * gain) for mu, d in zip(occupied, outcome, strict=True)])
        for gain in each
    )
    return Averages(*(float(value) for value in sums))


def check_rule(chain: Chain, rule: Rule) -> Rule:
    """The rule, if its shape fits."""
    shape = (chain.network.devices, chain.network.capacity + 1, 2, 2)
    if rule.ndim != 5 or rule.shape[1:] != shape:
        remedy = "Give a chance for each phase, device, buffer, arrival and acknowledgement"
        raise InputError("rule", f"shape (phase, {', '.join(map(str, shape))})", str(rule.shape), remedy)
    return rule


def senders(chain: Chain, phase: Float[np.ndarray, "device buffer arrival ack"]) -> np.ndarray:
    """Chance of each set of senders in each state, (state, subset)."""
    device = np.arange(chain.network.devices)
    chance = phase[device, chain.buffer, chain.arrival, chain.ack] * (chain.buffer > 0)
    pick = chain.subsets[None] == 1
    return np.prod(np.where(pick, chance[:, None], 1 - chance[:, None]), axis=2)


def deliveries(chain: Chain, senders: Float[np.ndarray, "state subset"]) -> np.ndarray:
    """Chance of each set of deliveries in each state, (state, subset)."""
    return senders @ chain.success


def transition(chain: Chain, deliveries: Float[np.ndarray, "state subset"]) -> np.ndarray:
    """Chance of the next state, (state, state)."""
    state, d, a = np.nonzero(chain.following >= 0)
    weight = deliveries[state, d] * chain.arrivals[state, a]
    place = state * chain.states + chain.following[state, d, a]
    return np.bincount(place, weight, chain.states**2).reshape(chain.states, chain.states)


def stationary(phases: list[Float[np.ndarray, "state state"]]) -> list[Float[np.ndarray, " state"]]:
    """Distribution over states at the start of each phase of a frame, in the long run.

    Raises:
        DtprobError: the long run depends on the start.
    """
    frame = np.linalg.multi_dot(phases) if len(phases) > 1 else phases[0]
    first = np.zeros(len(frame))
    first[0] = 1.0
    try:
        mu = np.linalg.solve((np.eye(len(frame)) - frame + first[None]).T, first)
    except np.linalg.LinAlgError:
        mu = np.full(len(frame), np.nan)
    if not np.max(np.abs(mu @ frame - mu)) < _TOLERANCE or np.min(mu) < -_TOLERANCE:
        raise DtprobError("exact solution: the rule's long run depends on where it starts")
    rows = [mu]
    for phase in phases[:-1]:
        rows.append(rows[-1] @ phase)
    return rows


def optimum(chain: Chain, *, tolerance: float = 1e-11) -> Solution:
    """The most that a controller who sees everything can deliver: relative value iteration.

    Args:
        chain: one that does not remember acknowledgements will do, and is smaller.
        tolerance: of the throughput, packets per slot.
    """
    each = gains(chain)
    possible = np.all(chain.subsets[None] <= chain.buffer[:, None], axis=2)
    value = np.zeros(chain.states)
    following = np.maximum(chain.following, 0)
    while True:
        later = np.einsum("sa,sda->sd", chain.arrivals, value[following])
        worth = (each.delivered + later) @ chain.success.T
        best = np.max(np.where(possible, worth, -np.inf), axis=1)
        change = best - value
        if np.ptp(change) < tolerance:
            break
        value += 0.5 * (change - change[0])  # half steps, so that periodic chains converge too
    choice = np.argmax(np.where(possible, worth, -np.inf), axis=1)
    outcome = chain.success[choice]
    mu = stationary([transition(chain, outcome)])[0]
    averages = Averages(*(float(np.sum(mu[:, None] * outcome * gain)) for gain in each))
    return Solution(averages, choice)
