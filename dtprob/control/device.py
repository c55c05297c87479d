"""One device's step of an exported recurrent policy, in NumPy alone: what to port to the device."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

type Weights = Mapping[str, np.ndarray]
"""What `dtprob.control.export.save` writes of a recurrent policy; the first axis is the device's."""


class Seen(NamedTuple):
    """What a device knows at the start of a slot.

    Attributes:
        buffer: packets that wait.
        arrival: whether a packet was generated at the end of the last slot.
        ack: whether a packet was delivered in the last slot.
        action: whether it wanted to send in the last slot.
        slot: slots since the episode began.
    """

    buffer: int
    arrival: int
    ack: int
    action: int
    slot: int


def step(
    weights: Weights, device: int, memory: Float[np.ndarray, " unit"], seen: Seen
) -> tuple[Float[np.ndarray, " unit"], float]:
    """What the device remembers then, and its chance of sending; memory starts an episode as zeros.

    A gated recurrent unit (Cho et al. 2014) over what is seen, and a hidden layer from both to the log-odds.

    Args:
        weights: of all devices.
        device: which one this is.
        memory: of the slot before.
        seen: at the start of the slot.
    """
    own = {name: value[device] for name, value in weights.items() if np.ndim(value)}
    phase = np.eye(int(weights["frame"]))[seen.slot % int(weights["frame"])]
    x = np.concatenate([2.0 * np.array(seen[:4]) - 1.0, phase])
    given = np.split(own["cell_input"] @ x + own["cell_bias"], 3)
    kept = np.split(own["cell_hidden"] @ memory, 3)
    reset, update = (_sigmoid(a + b) for a, b in zip(given[:2], kept[:2], strict=True))
    new = np.tanh(given[2] + reset * (kept[2] + own["cell_new_bias"]))
    after = new + update * (memory - new)
    hidden = np.tanh(own["head_hidden"] @ np.concatenate([after, x]) + own["head_hidden_bias"])
    return after, float(_sigmoid(own["head_output"] @ hidden + own["head_output_bias"])[0])


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))
