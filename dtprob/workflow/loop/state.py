"""Where a loop stands, as one file that is there whole or not at all."""

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from dtprob.edition import edition
from dtprob.errors import InputError
from dtprob.files import atomic_write
from dtprob.models.multi_access import priors
from dtprob.workflow.loop.physical import COLUMNS, Chances, Rows
from dtprob.workflow.loop.settings import TwinCase

type Phase = Literal["collect", "learn", "control", "hand_over", "monitor", "diagnose", "done"]
type Tables = Mapping[str, np.ndarray]
"""Dirichlet concentrations of `log_arrival` and `log_reception`."""
type Entry = dict[str, Any]

_PLAIN = ("phase", "step", "round", "since", "handed", "watched", "changed", "entries")


class State(NamedTuple):
    """Where a loop stands.

    Attributes:
        phase: what comes next.
        step: how often something was done; where randomness starts.
        round: of learning, from 1.
        rows: all slots so far.
        since: the row from which on data count for `prior`.
        prior: what was known of the tables before these rows.
        policy: what the devices follow; the chances of sending.
        trained: a policy that is not handed over yet.
        foreseen: packets per slot of the episodes that were foreseen of the policy, see `foresight`.
        handed: the row from which on the policy is followed.
        watched: the row from which on the network is watched; -1 before that.
        detector: of the monitor, after each window that was judged; see `knowledge.watch`.
        changed: the row from which on the network is thought to be another; -1 without an alarm.
        entries: the history.
    """

    phase: Phase
    step: int
    round: int
    rows: Rows
    since: int
    prior: Tables
    policy: Chances
    trained: Chances
    foreseen: Float[np.ndarray, " episode"]
    handed: int
    watched: int
    detector: Float[np.ndarray, " window"]
    changed: int
    entries: tuple[Entry, ...]

    @property
    def slots(self) -> int:
        """Slots so far."""
        return len(self.rows["slot"])


def begin(case: TwinCase) -> State:
    """The state before the first slot: nothing known, all silent."""
    kernel = case.kernel
    wide = np.zeros((0, kernel.devices), np.int64)
    rows = {name: wide if name not in {"episode", "slot"} else wide[:, 0] for name in COLUMNS}
    silent = np.zeros((1, kernel.devices, kernel.capacity + 1, 2, 2))
    prior = priors(kernel.clusters, case.concentration, memory=case.memory)
    return State("collect", 0, 1, rows, 0, prior, silent, silent, np.zeros(0), 0, -1, np.zeros(0), -1, ())


def save(state: State, case: TwinCase, path: Path) -> None:
    """Write a state; numbers and text only."""
    plain = {name: getattr(state, name) for name in _PLAIN}
    arrays = {name: getattr(state, name) for name in ("policy", "trained", "foreseen", "detector")}
    arrays |= {f"rows.{name}": column for name, column in state.rows.items()}
    arrays |= {f"prior.{name}": table for name, table in state.prior.items()}
    with atomic_write(path) as file:
        text = {"identity": np.array(_identity(case)), "plain": np.array(json.dumps(plain))}
        np.savez(file, allow_pickle=False, **arrays, **text)


def load(case: TwinCase, path: Path) -> State:
    """Read what `save` wrote.

    Raises:
        InputError: a file of another case or version, or none of a loop.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = dict(stored)
        identity, plain = str(arrays.pop("identity")), json.loads(str(arrays.pop("plain")))
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(
            str(path), "a loop's state", type(error).__name__, "Begin without --resume"
        ) from None
    if identity != _identity(case):
        raise InputError(
            str(path), "the state of this case", "another's", "Begin without --resume, or in another folder"
        )
    parts: dict[str, dict[str, np.ndarray]] = {"rows": {}, "prior": {}}
    for name in [each for each in arrays if "." in each]:
        group, _, own = name.partition(".")
        parts[group][own] = arrays.pop(name)
    plain["entries"] = tuple(plain["entries"])
    return State(**plain, **parts, **arrays)  # pyright: ignore[reportArgumentType]


def _identity(case: TwinCase) -> str:
    """What a state depends on, as text; the paths of files do not matter."""
    parts = (case.model, case.physical, case.loop, case.effects, case.seed)
    return "\n".join([f"dtprob {edition()}", *map(repr, parts)])
