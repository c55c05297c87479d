"""Withheld cases of multi-access networks: a log from before, one in which something is wrong, and the key apart.

Each case is a folder with `case.toml`, `before.csv` and `after.csv`. The twin learns from the log before, which is a
sound network's; probabilities of arrivals and receptions differ from site to site and are told to nobody.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from dtprob.data.write import write
from dtprob.errors import InputError
from dtprob.files import atomic_write
from dtprob.physical.information import size_for
from dtprob.physical.key import checked, write_key
from dtprob.physical.multi_access.fault import Fault
from dtprob.physical.multi_access.faults import FAMILIES, FOREIGN, LISTED, draw
from dtprob.physical.multi_access.log import record
from dtprob.physical.multi_access.network import Network, reception

KINDS: Final = ("null", "listed", "unlisted", "pair")
SHARED: Final = 8
"""Cases of one network."""
BEFORE, AFTER, WINDOW = 3000, 600, 10
CONVENTION: Final = (
    "lambda is twice the divergence of the log's law from the sound network's, summed over slots, times"
    " before / (before + after) for what the twin absorbs when it is fitted to both logs"
)
_TRIES: Final = 60
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


def generate_cases(
    out: Path,
    count: int,
    seed: int,
    kinds: Sequence[str] = KINDS,
    lambda_: float | Sequence[float] = (25.0, 100.0, 400.0),
    *,
    families: Sequence[str] = LISTED,
    resume: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write withheld cases and their key.

    Case i is of kind `kinds[i % len(kinds)]`; its lambda is drawn from those given.

    Args:
        out: folder; cases go to `cases/NNNN`, `key.json` and `truth/NNNN.json` stay outside of `cases`.
        count: number of cases.
        seed: from which everything is drawn.
        kinds: "null" no fault, "listed" one fault, "unlisted" one whose family the case takes out of the library, or
            that never had an entry, "pair" one fault of the traffic and one of the channel.
        lambda_: information that each fault carries alone.
        families: which faults may occur.
        resume: keep the cases that are whole.
        progress: called with the number of cases done and `count`.

    Returns:
        The key's file.

    Raises:
        InputError: an unknown kind or family, or a lambda that no fault can reach.
    """
    lambdas = checked(kinds, lambda_, families, known_kinds=KINDS, known_families=FAMILIES)
    (out / "truth").mkdir(parents=True, exist_ok=True)
    for index in range(count):
        if not (resume and (out / "truth" / f"{index:04d}.json").is_file()):
            network = _network(np.random.default_rng([seed, index // SHARED, 0]))
            _write(
                out, index, seed, network, kind=kinds[index % len(kinds)], lambdas=lambdas, families=families
            )
        if progress:
            progress(index + 1, count)
    plan = {"before": BEFORE, "after": AFTER, "window": WINDOW}
    return write_key(out, count, seed, track="network", convention=CONVENTION, plan=plan)


def _network(rng: np.random.Generator) -> Network:
    """Four devices in two clusters, about as the reference system."""
    arrival = np.array([0.25, 0.35, 0.35, 0.05]) * np.exp(0.3 * rng.standard_normal((2, 1, 4)))
    first, second = rng.uniform(0.85, 1.0), rng.uniform([0.6, 0.1], [0.75, 0.2])
    table = reception([first], second.tolist(), [rng.uniform(0.1, 0.3), 0.02], [0.05, 0.01], senders=4)
    return Network(((0, 1), (2, 3)), 1, arrival / arrival.sum(axis=2, keepdims=True), table)


def _write(
    out: Path,
    index: int,
    seed: int,
    network: Network,
    *,
    kind: str,
    lambdas: Sequence[float],
    families: Sequence[str],
) -> None:
    """Simulate and write one case; its record comes last, as the sign that it is whole."""
    rng = np.random.default_rng([seed, index, 1])
    target = lambdas[int(rng.integers(len(lambdas)))]
    faults, excluded = _choose(rng, kind, network, target, families)
    name, draws = f"{index:04d}", (seed, index)
    folder = out / "cases" / name
    folder.mkdir(parents=True, exist_ok=True)
    write(folder / "before.csv", record((*draws, 2), network, BEFORE).log)
    after = record((*draws, 3), network, AFTER, [(one.fault, one.size) for one in faults])
    write(folder / "after.csv", after.log)
    with atomic_write(folder / "case.toml") as temporary:
        temporary.write_text(_toml(excluded, index), encoding="utf-8")
    about = {
        "name": name,
        "kind": kind,
        "lambda": target if faults else 0.0,
        "effects": [one.record() for one in faults],
        "excluded": list(excluded),
        "alias": None,
        "arrival": network.arrival.tolist(),
        "reception": network.reception.tolist(),
    }
    with atomic_write(out / "truth" / f"{name}.json") as temporary:
        temporary.write_text(json.dumps(about, indent=1), encoding="utf-8")


def _choose(
    rng: np.random.Generator, kind: str, network: Network, target: float, families: Sequence[str]
) -> tuple[tuple[_Active, ...], tuple[str, ...]]:
    """The faults of a case, and the families that it takes out of the library."""
    if kind == "null":
        return (), ()
    if kind == "unlisted" and rng.random() < 1 / 3:
        return (_sized(rng, network, target, FOREIGN),), ()
    one = _sized(rng, network, target, families)
    if kind == "unlisted":
        return (one,), (one.fault.family,)
    if kind == "listed":
        return (one,), ()
    for _ in range(_TRIES):
        other = _sized(rng, network, target, families)
        if (other.fault.arrivals is None) != (one.fault.arrivals is None):
            return (one, other), ()
    raise InputError(
        "withheld case", "faults of traffic and of the channel", "one of them", "Name more families"
    )


def _sized(rng: np.random.Generator, network: Network, target: float, families: Sequence[str]) -> _Active:
    """One fault of the right information."""
    seed = [int(rng.integers(2**31))]
    for _ in range(_TRIES):
        fault = draw(rng, str(rng.choice(np.asarray(families))), network)
        try:
            size, found = size_for(target, partial(_information, seed, network, fault), limit=fault.limit)
        except InputError:
            continue
        if abs(found / target - 1) <= _TOLERANCE:
            return _Active(fault, size, found)
    raise InputError("withheld case", f"a fault of lambda {target:g}", "none", "Ask for less")


def _information(seed: Sequence[int], network: Network, fault: Fault, size: float) -> float:
    return 2 * record(seed, network, AFTER, [(fault, size)]).divergence * BEFORE / (BEFORE + AFTER)


def _toml(excluded: Sequence[str], seed: int) -> str:
    left_out = f"exclude = {json.dumps(list(excluded))}\n" if excluded else ""
    return f"""[model]
name = "multi_access"

[model.options]
clusters = [[0, 1], [2, 3]]
capacity = 1
window = {WINDOW}
concentration = 0.5

[data]
file = "after.csv"
reference = "before.csv"

[effects]
use = "all"
{left_out}
[engine]
name = "laplace"

[seed]
value = {seed}
"""
