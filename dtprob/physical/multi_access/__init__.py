"""The ground truth of the multi-access network: its transition, and exact solutions of small ones.

Written apart from the twin's model of the same system, with which it shares no code.
"""

from dtprob.physical.multi_access.chain import Chain, chain
from dtprob.physical.multi_access.decentralised import improve, slopes
from dtprob.physical.multi_access.exact import Averages, Rule, average, optimum
from dtprob.physical.multi_access.kernel import PhysicalKernel, Rewards, Slot, State
from dtprob.physical.multi_access.network import Network, reception
from dtprob.physical.multi_access.rules import aloha, tdma

__all__ = [
    "Averages",
    "Chain",
    "Network",
    "PhysicalKernel",
    "Rewards",
    "Rule",
    "Slot",
    "State",
    "aloha",
    "average",
    "chain",
    "improve",
    "optimum",
    "reception",
    "slopes",
    "tdma",
]
