"""The state of a run on disk: HDF5 with arrays and one line of JSON, nothing that can run code."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, cast

import h5py
import jax
import numpy as np

from dtprob.errors import InputError
from dtprob.files import atomic_write

FORMAT = "dtprob checkpoint 1"
SAVE_EVERY = 1.0
"""Seconds between two checkpoints, at least: a step may take a thousandth of that."""
_SAVE_SHARE = 20


class Snapshot(NamedTuple):
    """What continues a run.

    Attributes:
        done: steps done.
        state: the leaves of the chains' state, in the order of `jax.tree.leaves`.
        draws: the draws so far, by name, (chain, draw, ...).
    """

    done: int
    state: list[np.ndarray]
    draws: dict[str, np.ndarray]


@dataclass
class Pace:
    """When to save: at most once in `SAVE_EVERY` seconds, and for at most a twentieth of the time."""

    _ended: float = field(default_factory=time.monotonic)
    _took: float = 0.0

    def is_due(self) -> bool:
        """Whether it is time to save."""
        return time.monotonic() - self._ended >= max(SAVE_EVERY, _SAVE_SHARE * self._took)

    def write(self, path: Path, identity: Mapping[str, Any], snapshot: Snapshot) -> None:
        """Save; see `write`."""
        begin = time.monotonic()
        write(path, identity, snapshot)
        self._ended = time.monotonic()
        self._took = self._ended - begin


def write(path: Path, identity: Mapping[str, Any], snapshot: Snapshot) -> None:
    """Write a checkpoint, whole or not at all.

    Args:
        path: the file.
        identity: what the run is: versions, model, data, settings, key.
        snapshot: where it is.
    """
    with atomic_write(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["format"] = FORMAT
        file.attrs["identity"] = json.dumps(identity, sort_keys=True)
        file.attrs["done"] = snapshot.done
        for index, leaf in enumerate(snapshot.state):
            file.create_dataset(f"state/{index:04d}", data=leaf)
        for name, values in snapshot.draws.items():
            file.create_dataset(f"draws/{name}", data=values)


def read(path: Path, identity: Mapping[str, Any]) -> Snapshot:
    """Read a checkpoint of the run that `identity` describes.

    Raises:
        InputError: the file is no checkpoint, or another run's; the error names the first difference.
    """
    what = f"checkpoint {path}"
    try:
        with h5py.File(path, "r") as file:
            found = {name: file.attrs.get(name) for name in ("format", "identity", "done")}
            state = [values for _, values in sorted(_arrays(file, "state").items())]
            draws = _arrays(file, "draws")
    except OSError as error:
        raise InputError(what, "an HDF5 file", str(error).splitlines()[0], _REMEDY) from error
    if found["format"] != FORMAT:
        raise InputError(what, f"format '{FORMAT}'", repr(found["format"]), _REMEDY)
    _same(what, json.loads(str(found["identity"])), json.loads(json.dumps(identity)))
    return Snapshot(int(found["done"] or 0), state, draws)


def _arrays(file: h5py.File, group: str) -> dict[str, np.ndarray]:
    if group not in file:
        return {}
    members = cast("h5py.Group", file[group])
    return {str(name): np.asarray(values) for name, values in members.items()}


_REMEDY = "Give the checkpoint of this run, or start anew without resume"


def _same(what: str, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    for name in wanted:
        if found.get(name) != wanted[name]:
            expected, got = f"{name} {wanted[name]!r}", repr(found.get(name))
            raise InputError(what, expected, got, _REMEDY)


def restore(leaves: list[np.ndarray], like: Any, what: str) -> Any:
    """The state of shape `like` (a pytree of shapes) from its leaves.

    Raises:
        InputError: the leaves do not fit.
    """
    shapes, structure = jax.tree.flatten(like)
    fits = len(leaves) == len(shapes) and all(
        leaf.shape == shape.shape and leaf.dtype == shape.dtype
        for leaf, shape in zip(leaves, shapes, strict=True)
    )
    if not fits:
        raise InputError(
            what, f"{len(shapes)} arrays of this model's shapes", f"{len(leaves)} others", _REMEDY
        )
    return jax.tree.unflatten(structure, [jax.numpy.asarray(leaf) for leaf in leaves])
