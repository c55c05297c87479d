"""Policies as files that a device can run: a table of chances, in JSON."""

import json
from pathlib import Path
from typing import Any, Final

import jax.numpy as jnp
import numpy as np

from dtprob.control.policy import TablePolicy
from dtprob.errors import InputError
from dtprob.files import atomic_write

_FORMAT: Final = "dtprob policy table 1"


def save(policy: TablePolicy, path: Path) -> None:
    """Write a table; it is there whole or not at all.

    The file has the chance of sending as nested lists: slot of the frame, device, packets that wait, arrival,
    acknowledgement. Digits are enough to give the same numbers back.

    Args:
        policy: see `dtprob.control.policy.tabulate` for memoryless networks.
        path: the file, `.json`.
    """
    axes = ["phase", "device", "buffer", "arrival", "ack"]
    table = np.asarray(policy.probability, float).tolist()
    with atomic_write(path) as file:
        content = {"format": _FORMAT, "axes": axes, "probability": table}
        file.write_text(json.dumps(content) + "\n", encoding="utf-8")


def load(path: Path) -> TablePolicy:
    """Read what `save` wrote.

    Raises:
        InputError: there is no such file, or it holds no table of chances.
    """
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
        table = np.asarray(content["probability"], float)
        valid = content["format"] == _FORMAT and table.ndim == 5 and table.shape[3:] == (2, 2)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(str(path), "a policy table", type(error).__name__, "Write it with save") from error
    if not valid or not np.all((table >= 0) & (table <= 1)):
        got = f"{content['format']!r} of shape {table.shape}"
        raise InputError(str(path), "chances of sending in five dimensions", got, "Write it with save")
    return TablePolicy(jnp.asarray(table))
