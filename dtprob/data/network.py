"""Network logs from the columns of a table: one row per slot, four columns per device."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from dtprob.data.arrays import ArraySpec, check_arrays, side_by_side
from dtprob.data.kinds import NetworkLog
from dtprob.data.network_rows import DEVICE_COLUMNS, split_gaps
from dtprob.errors import InputError, unknown_name

_NUMBERED = re.compile(r"(.+)_(\d+)")


def from_columns(columns: Mapping[str, np.ndarray], *, allow_gaps: bool = False) -> NetworkLog:
    """The log of a table with ``episode``, ``slot`` and ``buffer_k``, ``action_k``, ``ack_k``, ``arrival_k``.

    Args:
        columns: by name.
        allow_gaps: split episodes where slots are missing, and number episodes anew.

    Raises:
        InputError: a column that is missing or of no device, or rows that cannot be; see ``NetworkLog``.
    """
    if not isinstance(allow_gaps, bool):
        raise InputError("allow_gaps", "true or false", repr(allow_gaps), "Correct the value")
    devices = _devices(columns)
    for name in ("episode", "slot"):
        if name not in columns:
            raise InputError(name, "a column", "nothing", "Number the episodes and their slots from 0")
    logged = {name: np.asarray(columns[name]) for name in ("episode", "slot")}
    for column in DEVICE_COLUMNS:
        for device in range(devices):
            if f"{column}_{device}" not in columns:
                remedy = "Give every device from 0 its four columns"
                raise InputError(f"{column}_{device}", "a column", "nothing", remedy)
        own = [f"{column}_{device}" for device in range(devices)]
        logged[column] = side_by_side({name: columns[name] for name in own})
    if not len(logged["slot"]):
        raise InputError("episode", "at least one row", "an empty table", "Log one slot or more")
    if allow_gaps:
        whole = ArraySpec((("row",),), kind="integer")
        logged |= check_arrays({n: logged[n] for n in ("episode", "slot")}, {"episode": whole, "slot": whole})
        logged["episode"] = split_gaps(logged["episode"], logged["slot"])
    return NetworkLog(**logged)


def _devices(columns: Mapping[str, np.ndarray]) -> int:
    """Number of devices, one more than the highest that a column names."""
    numbers = [0]
    for name in columns:
        if name in {"episode", "slot"}:
            continue
        match = _NUMBERED.fullmatch(name)
        if match is None or match.group(1) not in DEVICE_COLUMNS:
            valid = ["episode", "slot", *(f"{column}_0" for column in DEVICE_COLUMNS)]
            raise unknown_name("column", name, valid, "column name")
        numbers.append(int(match.group(2)))
    return max(numbers) + 1
