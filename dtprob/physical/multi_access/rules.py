"""Fixed rules of access, as chances of sending: time slots, and random access."""

from collections.abc import Sequence

import numpy as np

from dtprob.physical.multi_access.exact import Rule
from dtprob.physical.multi_access.network import Network


def tdma(network: Network, frame: Sequence[Sequence[int]]) -> Rule:
    """Devices take turns.

    Args:
        network: whose devices.
        frame: for each slot of the frame, the devices that send in it.
    """
    rule = _blank(network, len(frame))
    for phase, devices in enumerate(frame):
        rule[phase, list(devices)] = 1.0
    return rule


def aloha(network: Network, probability: float) -> Rule:
    """Every device with a packet sends with the same chance in every slot."""
    return _blank(network, 1) + probability


def _blank(network: Network, phases: int) -> Rule:
    return np.zeros((phases, network.devices, network.capacity + 1, 2, 2))
