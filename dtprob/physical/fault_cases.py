"""What tracks of faulty Gaussian measurements share: which faults a case has, and the records of its key."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from dtprob.errors import InputError
from dtprob.files import atomic_write
from dtprob.physical.gaussian import Bench, Fault, Sized, sized, visible

KINDS: Final = ("null", "listed", "unlisted", "pair", "triple")
_TRIES: Final = 60
_APART: Final = 0.5
"""Faults of one case correlate less than this in what the twin cannot imitate."""
_SILENT: Final = 1e-6
"""Standard deviations of a mean below which a fault leaves it alone."""


class Choice(NamedTuple):
    """The faults of a case, and the families that it takes out of the library."""

    faults: tuple[Sized, ...] = ()
    excluded: tuple[str, ...] = ()


class Families(NamedTuple):
    """How faults are drawn.

    Attributes:
        draw: (rng, family) -> a fault of it.
        known: families that the library of effects has.
        foreign: families that no library has.
    """

    draw: Callable[[np.random.Generator, str], Fault]
    known: Sequence[str]
    foreign: Sequence[str]


def choose(rng: np.random.Generator, kind: str, bench: Bench, target: float, families: Families) -> Choice:
    """The faults of a case.

    Args:
        rng: source of randomness.
        kind: of case.
        bench: the sound measurement.
        target: lambda of each fault alone.
        families: from which faults are drawn.

    Raises:
        InputError: nothing that fits was found.
    """
    if kind == "null":
        return Choice()
    if kind == "unlisted" and rng.random() < 0.5:
        return Choice((_one(rng, bench, target, families, families.foreign),))
    one = _one(rng, bench, target, families, families.known)
    if kind == "unlisted":
        return Choice((one,), (one.fault.family,))
    found = [one]
    count = {"listed": 1, "pair": 2, "triple": 3}[kind]
    for _ in range(_TRIES):
        if len(found) == count:
            return Choice(tuple(found))
        other = _one(rng, bench, target, families, families.known)
        if all(_apart(bench, other, before) for before in found):
            found.append(other)
    raise InputError("withheld case", f"{count} faults that can be told apart", "fewer", "Name more families")


def _one(
    rng: np.random.Generator, bench: Bench, target: float, families: Families, names: Sequence[str]
) -> Sized:
    for _ in range(_TRIES):
        fault = families.draw(rng, str(rng.choice(np.asarray(names))))
        try:
            found = sized(bench, fault, target)
        except InputError:
            continue
        if found is not None:
            return found
    raise InputError("withheld case", f"a fault of lambda {target:g}", "none", "Ask for less")


def _apart(bench: Bench, one: Sized, other: Sized) -> bool:
    if one.fault.family == other.fault.family:
        return False
    a, b = (visible(bench, each.fault.change(bench.law, each.size)) for each in (one, other))
    norms = np.linalg.norm(a), np.linalg.norm(b)
    if max(norms) < _SILENT:
        return False
    return bool(abs(np.sum(a * b)) <= _APART * norms[0] * norms[1])


def write_record(
    out: Path, name: str, kind: str, target: float, *, choice: Choice, more: Mapping[str, Any]
) -> None:
    """Write what is true of one case, `truth/NAME.json`; it comes last, as the sign that the case is whole.

    Args:
        out: folder of the study.
        name: of the case.
        kind: of case.
        target: lambda that was asked for.
        choice: its faults.
        more: what else the key tells.
    """
    record = {
        "name": name,
        "kind": kind,
        "lambda": target if choice.faults else 0.0,
        "effects": [one.record() for one in choice.faults],
        "excluded": list(choice.excluded),
        "alias": None,
        **more,
    }
    with atomic_write(out / "truth" / f"{name}.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1), encoding="utf-8")
