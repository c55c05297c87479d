"""The best local rule that can be found: every device decides by what it sees itself and the slot of the frame."""

from typing import NamedTuple

import numpy as np

from dtprob.errors import DtprobError
from dtprob.physical.multi_access.chain import Chain
from dtprob.physical.multi_access.exact import (
    Averages,
    Rule,
    average,
    check_rule,
    deliveries,
    gains,
    senders,
    stationary,
    transition,
)

_LEAST_GAIN = 1e-9


class Found(NamedTuple):
    """A rule that no change of a single decision improves.

    Attributes:
        rule: all its chances are 0 or 1.
        averages: what it achieves.
    """

    rule: Rule
    averages: Averages


def improve(chain: Chain, rule: Rule) -> Found:
    """Ascend to a rule whose throughput no single decision improves.

    The throughput is monotone in each single chance while the others are kept, so that the best value of a
    chance is 0 or 1, and its slope says which. The steepest wrong chance is set right until none is left. Then
    one of the chances between 0 and 1 is set, which alone does not matter but may give the others slopes.

    Args:
        chain: that knows the last acknowledgements.
        rule: where to start.
    """
    rule = np.array(check_rule(chain, rule), float)
    rule[:, :, 0] = np.round(rule[:, :, 0])  # an empty buffer sends nothing
    slope = slopes(chain, rule)
    while True:
        gain = np.where(slope > 0, 1 - rule, rule) * np.abs(slope)
        worst = np.unravel_index(np.argmax(gain), gain.shape)
        if gain[worst] >= _LEAST_GAIN:
            rule[worst] = float(slope[worst] > 0)
            slope = slopes(chain, rule)
            continue
        undecided = np.argwhere((rule > 0) & (rule < 1))
        if not len(undecided):
            return Found(rule, average(chain, rule))
        slope = _decide(chain, rule, tuple(undecided[0]), slope)


def _decide(chain: Chain, rule: Rule, place: tuple[int, ...], slope: Rule) -> Rule:
    """Set a chance that alone does not matter to 0 or 1, so that there still is one long run; gives the new slopes."""
    rule[place] = float(slope[place] > 0)
    try:
        return slopes(chain, rule)
    except DtprobError:  # from some starts the network would come to a standstill
        rule[place] = 1 - rule[place]
        return slopes(chain, rule)


def slopes(chain: Chain, rule: Rule) -> Rule:
    """Derivative of the throughput with respect to each chance of a rule."""
    chance = [senders(chain, phase) for phase in rule]
    outcome = [deliveries(chain, each) for each in chance]
    move = [transition(chain, each) for each in outcome]
    occupied = stationary(move)
    gain = gains(chain).delivered
    reward = [np.sum(each * gain, axis=1) for each in outcome]
    bias = _bias(move, reward)
    following = np.maximum(chain.following, 0)
    table = np.zeros_like(rule)
    for phase in range(len(rule)):
        later = bias[(phase + 1) % len(rule)]
        worth = (gain + np.einsum("sa,sda->sd", chain.arrivals, later[following])) @ chain.success.T
        _add_slopes(chain, rule[phase], occupied[phase], worth, table[phase])
    return table / len(rule)


def _add_slopes(
    chain: Chain, phase: np.ndarray, occupied: np.ndarray, worth: np.ndarray, table: np.ndarray
) -> None:
    devices = np.arange(chain.network.devices)
    full = phase[devices, chain.buffer, chain.arrival, chain.ack] * (chain.buffer > 0)
    for device in devices:
        others = np.delete(devices, device)
        pick = chain.subsets[:, others][None] == 1
        chance = np.prod(np.where(pick, full[:, None, others], 1 - full[:, None, others]), axis=2)
        sign = 2 * chain.subsets[:, device] - 1
        advantage = occupied * np.sum(chance * sign * worth, axis=1) * (chain.buffer[:, device] > 0)
        place = device, chain.buffer[:, device], chain.arrival[:, device], chain.ack[:, device]
        np.add.at(table, place, advantage)


def _bias(move: list[np.ndarray], reward: list[np.ndarray]) -> list[np.ndarray]:
    """Relative value of each state at the start of each phase; zero for the empty network at the first."""
    total, table = np.zeros(len(move[0])), np.eye(len(move[0]))
    for own, gain in zip(move, reward, strict=True):
        total, table = total + table @ gain, table @ own
    system = np.eye(len(table)) - table
    system[:, 0] = 1.0  # the first unknown is the average over a frame, in place of the value of state 0
    solved = np.linalg.solve(system, total)
    frame, first = solved[0], np.concatenate([[0.0], solved[1:]])
    rows = [first]
    for own, gain in zip(reversed(move), reversed(reward), strict=True):
        rows.append(gain - frame / len(move) + own @ rows[-1])
    return rows[:0:-1]
