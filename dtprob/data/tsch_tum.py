"""Reader of the measured set tum-lkn/tschdata: packets of IEEE 802.15.4e nodes and what each hop took.

Only packets that reached the root are in it, so a hop's attempts are those of hops that succeeded, at most three.
"""

from __future__ import annotations

import ast
import gzip
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast, final

import numpy as np
from jaxtyping import Int

from dtprob.errors import InputError

ATTEMPTS = 3
"""Transmissions that a hop may take."""
_BYTES, _HEAD, _HOP = 38, 14, 4


@final
@dataclass(frozen=True, eq=False)
class Hops:
    """One row per hop of a delivered packet, in the order of arrival at the root.

    Attributes:
        packet: number of the packet among those kept.
        source: address of the node that generated it.
        node: address of the hop's sender.
        attempt: transmissions before the one that succeeded, 0 to 2.
        channel: frequency channel, 11 to 26.
        rssi: received power as the radio reports it, a positive number of dB below its reference.
        generated: slot number of the packet's generation.
        received: slot number of its arrival at the root.
    """

    packet: Int[np.ndarray, " hop"]
    source: Int[np.ndarray, " hop"]
    node: Int[np.ndarray, " hop"]
    attempt: Int[np.ndarray, " hop"]
    channel: Int[np.ndarray, " hop"]
    rssi: Int[np.ndarray, " hop"]
    generated: Int[np.ndarray, " hop"]
    received: Int[np.ndarray, " hop"]


def hops(path: Path) -> Hops:
    """Read a log of the set, its duplicates left out.

    Args:
        path: a `.log` or `.log.gz` file: a line per packet, 38 bytes in brackets and a time.

    Raises:
        InputError: no such file, or a line that is no packet; the line is named.
    """
    if not path.is_file():
        raise InputError(str(path), "a log of tsch_tum", "no such file", "Check the name and the folder")
    opener = gzip.open if path.suffix == ".gz" else open
    rows: list[tuple[int, ...]] = []
    seen: set[tuple[int, ...]] = set()
    packet = 0
    with opener(path, "rt", encoding="ascii") as file:
        for number, line in enumerate(file, start=1):
            content = _content(f"{path.name}, line {number}", line)
            received, generated = (_slot(content[start : start + 5]) for start in (1, 6))
            own = [content[i : i + _HOP] for i in range(_HEAD, _BYTES, _HOP) if content[i]]
            identity = (own[0][0], generated, content[11], content[12])
            if identity in seen:
                continue
            seen.add(identity)
            rows += _rows(packet, own, generated, received)
            packet += 1
    if not rows:
        raise InputError(path.name, "one packet or more", "none", "Choose another file")
    return Hops(*np.array(rows).T)


def _rows(packet: int, own: list[list[int]], generated: int, received: int) -> Iterator[tuple[int, ...]]:
    for node, left, channel, rssi in own:
        yield packet, own[0][0], node, ATTEMPTS - left, channel, rssi, generated, received


def _content(where: str, line: str) -> list[int]:
    """The bytes of a line, checked."""
    text = line.split("\t", maxsplit=1)[0]
    try:
        found = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        found = None
    if not isinstance(found, list) or len(cast("list[object]", found)) != _BYTES:
        raise InputError(where, f"{_BYTES} bytes in brackets", repr(text[:40]), "Use the log as published")
    content = cast("list[object]", found)
    if not all(isinstance(b, int) and 0 <= b < 256 for b in content):
        raise InputError(where, "bytes from 0 to 255", repr(text[:40]), "Use the log as published")
    numbers = cast("list[int]", content)
    left = [numbers[i + 1] for i in range(_HEAD, _BYTES, _HOP) if numbers[i]]
    if not left or not all(1 <= one <= ATTEMPTS for one in left):
        got = ", ".join(map(str, left)) or "no hop"
        raise InputError(
            where, f"hops with 1 to {ATTEMPTS} transmissions left", got, "Use the log as published"
        )
    return numbers


def _slot(digits: list[int]) -> int:
    """A slot number from its five bytes, the least significant first."""
    return sum(byte << (8 * place) for place, byte in enumerate(digits))
