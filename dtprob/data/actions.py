"""What devices are to do in a slot, by their names, as environments of several agents have it."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from jaxtyping import Int

from dtprob.errors import InputError


class Space(Protocol):
    """What an agent may do, such as a space of gymnasium."""

    def contains(self, x: Any, /) -> bool:
        """Whether it may do this."""
        ...


def actions_in_order(
    agents: Sequence[str], actions: Mapping[str, Any], spaces: Mapping[str, Space]
) -> Int[np.ndarray, " device"]:
    """The devices' actions in their order: 0 to be silent, 1 to send.

    Args:
        agents: names of the devices.
        actions: of each, by name.
        spaces: what each may do, by name.

    Raises:
        InputError: a device without an action, an action that there is not, or one of no device of the network.
    """
    missing = [agent for agent in agents if agent not in actions]
    if missing:
        raise InputError(
            "actions", f"one of each of {agents}", f"none of {missing}", "Give an action for every device"
        )
    for agent, action in actions.items():
        if agent not in agents:
            raise InputError("actions", f"those of {agents}", f"one of {agent!r}", "Leave it out")
        if not spaces[agent].contains(action if isinstance(action, int) else np.asarray(action)):
            raise InputError(f"action of {agent}", "0 (silent) or 1 (sends)", repr(action), "Correct it")
    return np.array([int(actions[agent]) for agent in agents])
