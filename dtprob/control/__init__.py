"""Control of a network by decentralised policies: environments, learners, rewards for collecting data.

An `Environment` plays any transition kernel with parameters from any sampler: a posterior, a point estimate or
the ground truth train and judge policies through the same code. PettingZoo is needed only by
`dtprob.control.pettingzoo`.
"""

from dtprob.control.collection import collector
from dtprob.control.coma import COMA
from dtprob.control.environment import Environment, NetworkReward, Observation, Step
from dtprob.control.information import Counts, DirichletInformation, SampledInformation
from dtprob.control.ippo import IPPO
from dtprob.control.kernel import Kernel
from dtprob.control.learner import Budget, Learner, Trained, train
from dtprob.control.policy import FramePolicy, HistoryPolicy, Policy, TablePolicy, aloha, tabulate, tdma
from dtprob.control.rollout import Stateless, evaluate
from dtprob.twin.rollout import draw_pool

__all__ = [
    "COMA",
    "IPPO",
    "Budget",
    "Counts",
    "DirichletInformation",
    "Environment",
    "FramePolicy",
    "HistoryPolicy",
    "Kernel",
    "Learner",
    "NetworkReward",
    "Observation",
    "Policy",
    "SampledInformation",
    "Stateless",
    "Step",
    "TablePolicy",
    "Trained",
    "aloha",
    "collector",
    "draw_pool",
    "evaluate",
    "tabulate",
    "tdma",
    "train",
]
