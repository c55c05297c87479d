"""Withheld cases of multi-access networks: a log from before, one in which something is wrong, and the key apart.

Each case is a folder with `case.toml`, `before.csv` and `after.csv`. The twin learns from the log before, which is a
sound network's; probabilities of arrivals and receptions differ from site to site and are told to nobody.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from dtprob.data.write import write
from dtprob.errors import InputError
from dtprob.files import write_text
from dtprob.physical.cells import touched
from dtprob.physical.information import size_for
from dtprob.physical.multi_access.divergence import information
from dtprob.physical.multi_access.fault import Fault, Past
from dtprob.physical.multi_access.faults import FAMILIES, FOREIGN, LISTED, draw
from dtprob.physical.multi_access.likeness import likeness
from dtprob.physical.multi_access.log import record
from dtprob.physical.multi_access.network import Network, reception
from dtprob.physical.study import Order, Track, case_end

KINDS: Final = ("null", "listed", "unlisted", "pair", "triple", "alias")
_TAKEN_OUT: Final = 2 / 3
"""Share of the unlisted causes whose family is taken out of the library; the others never had an entry."""
BEFORE, AFTER, WINDOW = 3000, 600, 10
CONVENTION: Final = (
    "lambda is twice the divergence of the law of both logs from that of one network whose tables are fitted to both;"
    " exact for every size"
)
_MODEL: Final = f"""[model]
name = "multi_access"

[model.options]
clusters = [[0, 1], [2, 3]]
capacity = 1
window = {WINDOW}
concentration = 0.5

[data]
file = "after.csv"
reference = "before.csv"

"""
_TRIES: Final = 60
_POOL: Final = 8
"""Faults among which an alias is looked for."""
_APART: Final = 0.5
"""Faults of one case look less alike than this."""
_TOLERANCE: Final = 0.15


@dataclass(frozen=True)
class _Active:
    fault: Fault
    size: float
    lambda_: float

    def record(self) -> dict[str, Any]:
        fault = self.fault
        about = {"name": fault.name, "family": fault.family, "instance": fault.instance}
        return {**about, "size": self.size, "unit": "1", "lambda": self.lambda_}


def _network(rng: np.random.Generator, _number: int, _families: Sequence[str]) -> Network:
    """Four devices in two clusters, about as the reference system."""
    arrival = np.array([0.25, 0.35, 0.35, 0.05]) * np.exp(0.3 * rng.standard_normal((2, 1, 4)))
    first, second = rng.uniform(0.85, 1.0), rng.uniform([0.6, 0.1], [0.75, 0.2])
    table = reception([first], second.tolist(), [rng.uniform(0.1, 0.3), 0.02], [0.05, 0.01], senders=4)
    return Network(((0, 1), (2, 3)), 1, arrival / arrival.sum(axis=2, keepdims=True), table)


def _case(out: Path, order: Order, network: Network) -> dict[str, Any]:
    """Simulate and write one case."""
    faults, excluded, alias = _choose(order.rng, order.kind, network, order.lambda_, order.families)
    folder, draws = out / "cases" / order.name, (order.seed, order.index)
    folder.mkdir(parents=True, exist_ok=True)
    write(folder / "before.csv", record((*draws, 2), network, BEFORE))
    after = record((*draws, 3), network, AFTER, [(one.fault, one.size) for one in faults])
    write(folder / "after.csv", after)
    effects = [one.record() for one in faults]
    left_out = order.left_out(excluded, [*effects, alias], order.families, _TAKEN_OUT)
    write_text(folder / "case.toml", _MODEL + case_end(left_out, order.index))
    about = {"arrival": network.arrival.tolist(), "reception": network.reception.tolist()}
    return order.record(effects, left_out, alias, cells=_cells(network, faults), **about)


def _cells(network: Network, faults: Sequence[_Active]) -> dict[str, list[int]]:
    """The devices' clusters that faults of traffic touch, where these are no more than half of them."""
    acks = any(one.fault.acks is not None for one in faults)
    if acks or not faults:
        return {}
    sound = network.arrival[:, 0]
    before = np.ones(network.devices, int)
    change = sum(
        abs(one.fault.arrivals(sound, Past(slot, slot / AFTER, before), one.size) - sound)
        for one in faults
        if one.fault.arrivals is not None
        for slot in range(AFTER)
    )
    return touched(np.asarray(change).sum(axis=1), ("cluster",), sum(one.lambda_ for one in faults))


class _Choice(NamedTuple):
    """The faults of a case, the families that it takes out of the library, and what looks much like the fault."""

    faults: tuple[_Active, ...] = ()
    excluded: tuple[str, ...] = ()
    alias: Mapping[str, Any] | None = None


def _choose(
    rng: np.random.Generator, kind: str, network: Network, target: float, families: Sequence[str]
) -> _Choice:
    """What a case holds."""
    if kind == "null":
        return _Choice()
    if kind == "unlisted" and rng.random() < 1 - _TAKEN_OUT:
        return _Choice((_sized(rng, network, target, FOREIGN),))
    if kind == "alias":
        return _aliased(rng, network, target, families)
    one = _sized(rng, network, target, families)
    if kind == "unlisted":
        return _Choice((one,), (one.fault.family,))
    if kind == "listed":
        return _Choice((one,))
    found = [one]
    for _ in range(_TRIES):
        other = _sized(rng, network, target, families)
        if all(_apart(network, other, before) for before in found) and (
            len(found) > 1 or (other.fault.arrivals is None) != (one.fault.arrivals is None)
        ):
            found.append(other)
        if len(found) == (2 if kind == "pair" else 3):
            return _Choice(tuple(found))
    raise InputError("withheld case", "faults that can be told apart", "fewer", "Name more families")


def _apart(network: Network, one: _Active, other: _Active) -> bool:
    alike = likeness(network, (one.fault, one.size), (other.fault, other.size))
    return one.fault.family != other.fault.family and alike < _APART


def _aliased(rng: np.random.Generator, network: Network, target: float, families: Sequence[str]) -> _Choice:
    """Of several faults the one that looks most like another one of them, be it of the same family."""
    pool: dict[str, _Active] = {}
    for _ in range(_POOL):
        one = _sized(rng, network, target, families)
        pool.setdefault(one.fault.name, one)
    held = {name: (one.fault, one.size) for name, one in pool.items()}
    pairs = [(likeness(network, held[a], held[b]), a, b) for a in held for b in held if a != b]
    if not pairs:
        raise InputError("withheld case", "faults of two names", ", ".join(held), "Name more families")
    similar, true, other = max(pairs)
    return _Choice((pool[true],), alias={"name": other, "correlation": similar})


def _sized(rng: np.random.Generator, network: Network, target: float, families: Sequence[str]) -> _Active:
    """One fault of the right information."""
    for _ in range(_TRIES):
        fault = draw(rng, str(rng.choice(np.asarray(families))), network)
        try:
            told = partial(information, network, fault, before=BEFORE, after=AFTER)
            size, found = size_for(target, told, limit=fault.limit)
        except InputError:
            continue
        if abs(found / target - 1) <= _TOLERANCE:
            return _Active(fault, size, found)
    raise InputError("withheld case", f"a fault of lambda {target:g}", "none", "Ask for less")


TRACK: Final = Track(
    name="network",
    convention=CONVENTION,
    kinds=KINDS,
    usual=KINDS,
    families=tuple(FAMILIES),
    listed=LISTED,
    plan={"before": BEFORE, "after": AFTER, "window": WINDOW},
    campaign=_network,
    case=_case,
)
