"""The multi-access network as one would write it for PettingZoo: plain Python and NumPy, one slot at a time.

The rival of dtprob's compiled network. It knows nothing of dtprob, so that it runs in other environments too. Uniform
numbers are drawn in blocks and all else is small lists, which is faster than arrays of four.
"""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv

HORIZON = 2000


class PlainNetwork(ParallelEnv):
    """Devices with buffers that share a slotted channel.

    Args:
        clusters: the devices of each cluster.
        capacity: packets that a buffer holds.
        arrival: chances of each joint arrival of a cluster, (cluster, outcome).
        reception: chances of the number of deliveries, (senders, deliveries).
    """

    metadata: ClassVar[dict] = {"name": "plain_v0"}

    def __init__(
        self, clusters: Sequence[Sequence[int]], capacity: int, arrival: np.ndarray, reception: np.ndarray
    ) -> None:
        self.clusters, self.capacity = clusters, capacity
        self.possible_agents = [f"device_{number}" for number in range(sum(map(len, clusters)))]
        self.delivered = 0
        self._seen = Box(0, HORIZON, (4,), np.int64)
        self._acts = Discrete(2)
        self._arrival = [row.cumsum().tolist() for row in arrival]
        self._reception = [row.cumsum().tolist() for row in reception]

    def observation_space(self, agent: str) -> Box:
        """Buffer, arrival, acknowledgement, slot."""
        del agent
        return self._seen

    def action_space(self, agent: str) -> Discrete:
        """Silence or sending."""
        del agent
        return self._acts

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Empty buffers."""
        del options
        self.random = np.random.default_rng(seed)
        self.uniform: list[list[float]] = []
        self.agents = list(self.possible_agents)
        self.buffer = [0] * len(self.agents)
        self.slot = 0
        return dict.fromkeys(self.agents, (0, 0, 0, 0)), {agent: {} for agent in self.agents}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        """One slot."""
        if not self.uniform:
            self.uniform = self.random.random((1000, 1 + len(self.agents) + len(self._arrival))).tolist()
        uniform = self.uniform.pop()
        buffer, agents, capacity = self.buffer, self.agents, self.capacity
        senders = [i for i, agent in enumerate(agents) if actions[agent] and buffer[i]]
        count = sum(uniform[0] >= edge for edge in self._reception[len(senders)])
        ack = [0] * len(agents)
        for i in sorted(senders, key=lambda i: uniform[1 + i])[:count]:
            ack[i] = 1
        arrival = [0] * len(agents)
        for number, (cluster, edges) in enumerate(zip(self.clusters, self._arrival, strict=True)):
            outcome = sum(uniform[1 + len(agents) + number] >= edge for edge in edges)
            for place, device in enumerate(reversed(cluster)):
                arrival[device] = outcome >> place & 1
        reward = 0.0
        for i in range(len(agents)):
            full = buffer[i] + arrival[i] - ack[i]
            reward += 50 if ack[i] else -50 if full > capacity else -1
            buffer[i] = min(full, capacity)
        self.slot += 1
        done = self.slot >= HORIZON
        seen = {agent: (buffer[i], arrival[i], ack[i], self.slot) for i, agent in enumerate(agents)}
        self.delivered = count
        return (
            seen,
            dict.fromkeys(agents, reward),
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, done),
            {agent: {} for agent in agents},
        )
