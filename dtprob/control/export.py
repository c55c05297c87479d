"""Policies as files that a device can run: a table of chances in JSON, the weights of a recurrent network in NPZ."""

import json
import zipfile
from pathlib import Path
from typing import Any, Final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dtprob.control.policy import HistoryPolicy, TablePolicy
from dtprob.errors import InputError
from dtprob.files import atomic_write

_TABLE: Final = "dtprob policy table 1"
_RECURRENT: Final = "dtprob recurrent policy 1"
_WEIGHTS: Final = {
    "cell_input": lambda p: p.cells.weight_ih,
    "cell_hidden": lambda p: p.cells.weight_hh,
    "cell_bias": lambda p: p.cells.bias,
    "cell_new_bias": lambda p: p.cells.bias_n,
    "head_hidden": lambda p: p.heads.layers[0].weight,
    "head_hidden_bias": lambda p: p.heads.layers[0].bias,
    "head_output": lambda p: p.heads.layers[1].weight,
    "head_output_bias": lambda p: p.heads.layers[1].bias,
}
"""The arrays of a recurrent policy, each (device, ...); `dtprob.control.device.step` says how they are used."""


def save(policy: TablePolicy | HistoryPolicy, path: Path) -> None:
    """Write a policy; it is there whole or not at all.

    A table goes to JSON: the chance of sending as nested lists: slot of the frame, device, packets that wait, arrival,
    acknowledgement; digits are enough to give the same numbers back. A recurrent policy goes to NPZ.

    Args:
        policy: of a memoryless network its table, see `dtprob.control.policy.tabulate`.
        path: the file, `.json` for a table, `.npz` for a recurrent policy.

    Raises:
        InputError: a suffix that does not suit the policy.
    """
    suffix = ".json" if isinstance(policy, TablePolicy) else ".npz"
    if path.suffix != suffix:
        raise InputError(str(path), f"the suffix {suffix} for this policy", path.suffix, "Rename the file")
    with atomic_write(path) as file:
        if isinstance(policy, TablePolicy):
            axes = ["phase", "device", "buffer", "arrival", "ack"]
            table = np.asarray(policy.probability, float).tolist()
            content = {"format": _TABLE, "axes": axes, "probability": table}
            file.write_text(json.dumps(content) + "\n", encoding="utf-8")
        else:
            arrays = {name: np.asarray(of(policy)) for name, of in _WEIGHTS.items()}
            frame, label = np.array(policy.frame), np.array(_RECURRENT)
            np.savez(file, allow_pickle=False, format=label, frame=frame, **arrays)


def load(path: Path) -> TablePolicy | HistoryPolicy:
    """Read what `save` wrote.

    Raises:
        InputError: there is no such file, or it holds no policy.
    """
    try:
        return _recurrent(path) if path.suffix == ".npz" else _table(path)
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(str(path), "a policy", type(error).__name__, "Write it with save") from error


def _table(path: Path) -> TablePolicy:
    content: Any = json.loads(path.read_text(encoding="utf-8"))
    table = np.asarray(content["probability"], float)
    valid = content["format"] == _TABLE and table.ndim == 5 and table.shape[3:] == (2, 2)
    if not valid or not np.all((table >= 0) & (table <= 1)):
        got = f"{content['format']!r} of shape {table.shape}"
        raise InputError(str(path), "chances of sending in five dimensions", got, "Write it with save")
    return TablePolicy(jnp.asarray(table))


def _recurrent(path: Path) -> HistoryPolicy:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in (*_WEIGHTS, "format", "frame")}
    devices, _, width = arrays["cell_hidden"].shape
    policy = HistoryPolicy(jax.random.key(0), devices, int(arrays["frame"]), width)
    for name, of in _WEIGHTS.items():
        expected = of(policy).shape
        if str(arrays["format"]) != _RECURRENT or arrays[name].shape != expected:
            got = f"{arrays['format']} with {arrays[name].shape}"
            raise InputError(str(path), f"{_RECURRENT} with {name} {expected}", got, "Write it with save")
        policy = eqx.tree_at(of, policy, jnp.asarray(arrays[name]))
    return policy
