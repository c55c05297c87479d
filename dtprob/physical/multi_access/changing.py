"""A network that changes as it goes, as a PettingZoo environment in plain NumPy: the physical twin of studies."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv

from dtprob.data.actions import actions_in_order
from dtprob.errors import InputError
from dtprob.physical.multi_access.kernel import REWARDS
from dtprob.physical.multi_access.network import Network

type Seen = dict[str, np.ndarray]


@final
class ChangingNetwork(ParallelEnv[str, np.ndarray, int | None]):
    """All devices act at once; each sees its buffer, last arrival, last acknowledgement, and the slot.

    Every device is paid the network's reward. Which network holds depends on the slots since the last `reset` with a
    seed, whatever episodes they are of.

    Args:
        stages: the slot from which each network holds, the first 0; of the same clusters and capacity.
        horizon: slots of an episode.

    Raises:
        InputError: stages that do not begin at 0 in rising order, networks of other devices, or a horizon below 1.
    """

    def __init__(self, stages: Sequence[tuple[int, Network]], horizon: int = 1_000_000) -> None:
        starts = [start for start, _ in stages]
        if not starts or starts[0] != 0 or any(b <= a for a, b in itertools.pairwise(starts)):
            remedy = "Give the first stage slot 0, and the others later ones"
            raise InputError("stages", "slots that rise from 0", str(starts), remedy)
        first = stages[0][1]
        if any((net.clusters, net.capacity) != (first.clusters, first.capacity) for _, net in stages):
            raise InputError("stages", "the same devices in all", "others", "Change the tables only")
        if horizon < 1:
            raise InputError("horizon", "1 slot or more", str(horizon), "Give a larger number")
        self.metadata = {"name": "changing_multi_access_v0", "render_modes": [], "is_parallelizable": True}
        self.possible_agents = [f"device_{number}" for number in range(first.devices)]
        self.agents: list[str] = []
        self.render_mode = None
        most = np.array([first.capacity, 1, 1, horizon])
        self.observation_spaces = {
            agent: Box(np.zeros_like(most), most, dtype=np.int64) for agent in self.possible_agents
        }
        self.action_spaces: dict[str, Any] = {agent: Discrete(2) for agent in self.possible_agents}
        self._stages, self._horizon = list(stages), horizon
        self._random, self._total, self._begun = np.random.default_rng(), 0, False
        self._seen = np.zeros((first.devices, 4), np.int64)

    def observation_space(self, agent: str) -> gymnasium.Space[np.ndarray]:
        """Numbers of packets, arrivals, acknowledgements, and slots."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space[Any]:
        """0 to be silent, 1 to send."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Seen, dict[str, dict[str, Any]]]:
        """Start an episode with empty buffers.

        Args:
            seed: where randomness starts, and the first stage anew; without it, things go on, with new luck in the first.
            options: none are known.
        """
        del options
        if seed is not None:
            self._random, self._total = np.random.default_rng(seed), 0
            for number, agent in enumerate(self.possible_agents):  # each its own, or all would sample alike
                self.action_spaces[agent].seed(seed + number)
        self.agents = list(self.possible_agents)
        self._seen, self._begun = np.zeros_like(self._seen), True
        return self._shown(self.agents), {agent: {} for agent in self.agents}

    def step(
        self, actions: Mapping[str, int | None]
    ) -> tuple[Seen, dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """One slot.

        Args:
            actions: of every device; an episode that has ended takes none.

        Raises:
            InputError: no episode is under way, or actions that are not one of each device.
        """
        agents = self.agents
        if not self._begun or (not agents and actions):
            raise InputError("step", "an episode under way", "none", "Call reset first")
        if not agents:
            return {}, {}, {}, {}, {}
        wanted = actions_in_order(agents, actions, self.action_spaces)
        network = [net for start, net in self._stages if start <= self._total][-1]
        ack, arrival = self._luck(network, (wanted > 0) & (self._seen[:, 0] > 0))
        full = self._seen[:, 0] + arrival - ack
        overflow = full > network.capacity
        reward = float(np.sum(np.where(ack > 0, REWARDS.delivered, np.where(overflow, *REWARDS[1:]))))
        slot = self._seen[0, 3] + 1
        buffer = np.minimum(full, network.capacity)
        self._seen = np.stack([buffer, arrival, ack, np.full_like(ack, slot)], axis=1)
        self._total += 1
        done = bool(slot >= self._horizon)
        infos = {
            agent: {"delivered": int(ack[i]), "overflow": int(overflow[i])} for i, agent in enumerate(agents)
        }
        self.agents = [] if done else agents
        rewards = dict.fromkeys(agents, reward)
        return (
            self._shown(agents),
            rewards,
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, done),
            infos,
        )

    def state(self) -> np.ndarray:
        """What all devices see, (device, 4)."""
        return self._seen.copy()

    def render(self) -> None:
        """Nothing to show."""

    def close(self) -> None:
        """Nothing to close."""

    def _luck(self, network: Network, sends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Who is delivered, and where packets are generated."""
        senders = np.flatnonzero(sends)
        count = _outcome(self._random.random(), network.reception[len(senders)])
        ack, arrival = np.zeros(len(sends), np.int64), np.zeros(len(sends), np.int64)
        ack[self._random.permutation(senders)[:count]] = 1
        for number, cluster in enumerate(network.clusters):
            rows = network.arrival[number]
            digits = 2 ** np.arange(len(cluster))[::-1]
            previous = int(self._seen[list(cluster), 1] @ digits) if len(rows) > 1 else 0
            arrival[list(cluster)] = (_outcome(self._random.random(), rows[previous]) & digits) > 0
        return ack, arrival

    def _shown(self, agents: Sequence[str]) -> Seen:
        return {agent: self._seen[number].copy() for number, agent in enumerate(agents)}


def changing_network(
    *,
    pairs: int = 2,
    capacity: int = 1,
    disconnect: Sequence[Sequence[int]] = (),
    horizon: int = 1_000_000,
) -> ChangingNetwork:
    """A network of pairs of devices, see `Network.pairs`, some of which fall silent as it goes.

    Args:
        pairs: clusters of two devices; two are the seed report's network.
        capacity: packets that a buffer holds.
        disconnect: pairs of a slot and a device that generates no packets from then on.
        horizon: slots of an episode.

    Raises:
        InputError: see `ChangingNetwork`, or a device that is not there.
    """
    stages = [(0, Network.pairs(pairs, capacity))]
    for slot, device in disconnect:
        stages.append((slot, stages[-1][1].without(device)))
    return ChangingNetwork(stages, horizon)


def _outcome(uniform: float, row: np.ndarray) -> int:
    """The outcome whose share of [0, 1) holds `uniform`; never one of probability zero."""
    cumulative = np.cumsum(row)
    return int(np.sum(uniform >= cumulative / cumulative[-1]))
