"""What the rows of a network log must be to each other: slots without gaps, transitions that can happen."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from jaxtyping import Bool, Int

from dtprob.errors import InputError

DEVICE_COLUMNS = ("buffer", "action", "ack", "arrival")
"""What a log has of each device."""


class Rows(Protocol):
    """The columns of a log, sorted by episode and slot."""

    @property
    def episode(self) -> Int[np.ndarray, " row"]: ...  # noqa: D102

    @property
    def slot(self) -> Int[np.ndarray, " row"]: ...  # noqa: D102

    @property
    def buffer(self) -> Int[np.ndarray, "row device"]: ...  # noqa: D102

    @property
    def action(self) -> Int[np.ndarray, "row device"]: ...  # noqa: D102

    @property
    def ack(self) -> Int[np.ndarray, "row device"]: ...  # noqa: D102

    @property
    def arrival(self) -> Int[np.ndarray, "row device"]: ...  # noqa: D102


def check_rows(log: Rows, order: Int[np.ndarray, " row"]) -> None:
    """Check that every row can be, and can follow the one before it.

    Args:
        log: sorted by episode and slot.
        order: for each sorted row its place in the file, from 0.

    Raises:
        InputError: a slot that stands twice or is missing, an empty episode, a delivery without a transmission or from
            an empty buffer, or a buffer that cannot follow from the one before; the row of the file is named.
    """
    for name in ("action", "ack", "arrival"):
        if (bad := (values := getattr(log, name)) > 1).any():
            got = f"{values[_first(order, bad)].max()} in {where(log, order, bad)}"
            remedy = f"Give {name} as 0 or 1 per device and slot"
            raise InputError(_column(name, order, bad), "0 or 1", got, remedy)
    _check_order(log, order)
    if (bad := (log.ack > 0) & (log.action == 0)).any():
        remedy = "A packet is delivered only in a slot in which it is sent; correct the row"
        raise InputError(
            _column("ack", order, bad), "0 where the action is 0", f"1 in {where(log, order, bad)}", remedy
        )
    if (bad := (log.ack > 0) & (log.buffer == 0)).any():
        remedy = "An empty buffer has nothing to deliver; correct the row"
        raise InputError(
            _column("ack", order, bad), "0 where the buffer is 0", f"1 in {where(log, order, bad)}", remedy
        )
    _check_buffers(log, order)


def where(log: Rows, order: Int[np.ndarray, " row"], bad: Bool[np.ndarray, "..."]) -> str:
    """The first bad row in words: its number in the file from 1 (below a header), episode and slot."""
    first = _first(order, bad)
    return f"row {order[first] + 1} (episode {log.episode[first]}, slot {log.slot[first]})"


def _first(order: Int[np.ndarray, " row"], bad: Bool[np.ndarray, "..."]) -> int:
    """Which of the bad rows stands first in the file, by its number among the sorted ones."""
    index = np.flatnonzero(bad.reshape(len(order), -1).any(axis=1))
    return int(index[np.argmin(order[index])])


def follows(log: Rows) -> Bool[np.ndarray, " row"]:
    """Whether each row continues the episode of the row before it."""
    same = np.zeros(len(log.episode), dtype=bool)
    same[1:] = np.diff(log.episode) == 0
    return same


def split_gaps(episode: Int[np.ndarray, " row"], slot: Int[np.ndarray, " row"]) -> Int[np.ndarray, " row"]:
    """Episodes numbered anew from 0, split wherever a slot is missing, in the order of the rows given."""
    order = np.lexsort((slot, episode))
    starts = (np.diff(episode[order]) != 0) | (np.diff(slot[order]) > 1)
    numbers = np.empty(len(order), dtype=np.int64)
    numbers[order] = np.concatenate([[0], np.cumsum(starts)])
    return numbers


def _check_order(log: Rows, order: Int[np.ndarray, " row"]) -> None:
    step, inside = np.diff(log.slot, prepend=log.slot[:1]), follows(log)
    if (bad := inside & (step == 0)).any():
        row = _first(order, bad)
        got = f"slot {log.slot[row]} of episode {log.episode[row]} twice, again in {where(log, order, bad)}"
        remedy = "Number the slots within each episode"
        raise InputError("slot", "each slot of an episode once", got, remedy)
    if (bad := inside & (step > 1)).any():
        row = _first(order, bad)
        expected = f"slot {log.slot[row - 1] + 1} of episode {log.episode[row]}"
        remedy = (
            "Add the missing slots, or set allow_gaps = true in [data.options] to split the episode there"
        )
        raise InputError("slot", expected, where(log, order, bad), remedy)
    jump = np.diff(log.episode, prepend=log.episode[:1])
    if (bad := jump > 1).any():
        row = _first(order, bad)
        got = f"none: after episode {log.episode[row - 1]} comes {where(log, order, bad)}"
        remedy = "Number the episodes without gaps, or set allow_gaps = true in [data.options]"
        raise InputError("episode", f"a slot or more of episode {log.episode[row - 1] + 1}", got, remedy)


def _check_buffers(log: Rows, order: Int[np.ndarray, " row"]) -> None:
    kept = log.buffer - log.ack
    after, inside = np.roll(log.buffer, -1, axis=0), np.append(follows(log)[1:], False)
    bad = inside[:, None] & ((after < kept) | (after > kept + log.arrival))
    if bad.any():
        shifted = np.roll(bad, 1, axis=0)
        row = _first(order, shifted) - 1
        device = int(np.argmax(bad[row]))
        expected = f"{kept[row, device]}" + (
            f" or {kept[row, device] + 1}" if log.arrival[row, device] else ""
        )
        got = f"{after[row, device]} in {where(log, order, shifted)}"
        remedy = "A buffer changes by its arrival and its delivery only; correct the rows"
        raise InputError(f"buffer_{device}", f"{expected} after the slot before", got, remedy)


def _column(name: str, order: Int[np.ndarray, " row"], bad: Bool[np.ndarray, "row device"]) -> str:
    """The first bad column of the first bad row."""
    return f"{name}_{int(np.argmax(bad[_first(order, bad)]))}"
