"""The network as a PettingZoo environment, for agents and tools of others."""

from collections.abc import Mapping
from typing import Any, final

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec

from dtprob.control.environment import Environment, Observation
from dtprob.data.actions import actions_in_order
from dtprob.errors import InputError

type Seen = dict[str, np.ndarray]


@final
class ParallelNetwork(ParallelEnv[str, np.ndarray, int | None]):
    """All devices act at once; each sees its buffer, last arrival, last acknowledgement, and the slot.

    Every device is paid the network's reward. Episodes are truncated at the environment's horizon. Parameters
    are redrawn as the environment says.

    Args:
        environment: the network.
    """

    def __init__(self, environment: Environment) -> None:
        self.metadata = {"name": "multi_access_v0", "render_modes": [], "is_parallelizable": True}
        self.possible_agents = [f"device_{number}" for number in range(environment.devices)]
        self.agents: list[str] = []
        self.render_mode = None
        most = np.array([environment.kernel.capacity, 1, 1, environment.horizon])
        self.observation_spaces = {
            agent: Box(np.zeros_like(most), most, dtype=np.int64) for agent in self.possible_agents
        }
        self.action_spaces: dict[str, Any] = {agent: Discrete(2) for agent in self.possible_agents}
        self._start = eqx.filter_jit(environment.reset)
        self._move = eqx.filter_jit(environment.step)
        self._key = jax.random.key(int(np.random.SeedSequence().generate_state(1)[0]))
        self._state: Any = None
        self._seen: Observation | None = None

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
            seed: where randomness starts; without it, it goes on from the last episode, and of the first is new each time.
            options: none are known.
        """
        del options
        if seed is not None:
            self._key = jax.random.key(seed)
        self._key, key = jax.random.split(self._key)
        self._state, self._seen = self._start(key)
        self.agents = list(self.possible_agents)
        for number, agent in enumerate(self.agents):
            if seed is not None:  # each its own, or all devices would sample the same actions
                self.action_spaces[agent].seed(seed + number)
        return _seen(self.agents, self._seen), {agent: {} for agent in self.agents}

    def step(
        self, actions: Mapping[str, int | None]
    ) -> tuple[Seen, dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """One slot.

        Args:
            actions: of every device; an episode that has ended takes none.

        Raises:
            InputError: no episode is under way, or actions that are not one of each device.
        """
        if self._state is None or (not self.agents and actions):
            raise InputError("step", "an episode under way", "none", "Call reset first")
        if not self.agents:
            return {}, {}, {}, {}, {}
        wanted = actions_in_order(self.agents, actions, self.action_spaces)
        self._key, key = jax.random.split(self._key)
        self._state, step = self._move(key, self._state, jnp.asarray(wanted, jnp.int32))
        agents, done = self.agents, bool(step.truncated)
        self._seen = step.final_observation
        infos = {
            agent: {"delivered": int(step.slot.delivered[i]), "overflow": int(step.slot.overflow[i])}
            for i, agent in enumerate(agents)
        }
        if done:
            self.agents = []
        return (
            _seen(agents, self._seen),
            dict.fromkeys(agents, float(step.reward)),
            dict.fromkeys(agents, bool(step.terminated)),
            dict.fromkeys(agents, done),
            infos,
        )

    def state(self) -> np.ndarray:
        """What all devices see, (device, 4)."""
        if self._seen is None:
            raise InputError("state", "an episode under way", "none", "Call reset first")
        return np.stack(list(_seen(self.possible_agents, self._seen).values()))

    def render(self) -> None:
        """Nothing to show."""

    def close(self) -> None:
        """Nothing to close."""


def turn_based(environment: Environment) -> AECEnv[str, np.ndarray, int | None]:
    """The same with one device after the other, by PettingZoo's own wrapper."""
    return parallel_to_aec(ParallelNetwork(environment))


def _seen(agents: list[str], observation: Observation) -> Seen:
    local = np.stack([np.asarray(part) for part in observation[:3]], axis=-1).astype(np.int64)
    slot = int(observation.slot)
    return {agent: np.append(row, slot) for agent, row in zip(agents, local, strict=True)}
