"""What tracks of faulty Gaussian measurements share: which faults a case has, and how it is written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from dtprob.errors import InputError
from dtprob.physical.gaussian import Bench, Fault, Sized, Vector, measure, sized, visible
from dtprob.physical.study import Order

KINDS: Final = ("null", "listed", "unlisted", "pair", "triple")
_TRIES: Final = 60
_PATIENCE: Final = 8
"""Faults that may be too much like the others before these are drawn anew."""
_APART: Final = 0.5
"""Faults of one case correlate less than this in what the twin cannot imitate."""


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
    found, count = [one], {"listed": 1, "pair": 2, "triple": 3}[kind]
    for attempt in range(1, _TRIES):
        if len(found) == count:
            return Choice(tuple(found))
        other = _one(rng, bench, target, families, families.known)
        if all(_apart(bench, other, before) for before in found):
            found.append(other)
        elif attempt % _PATIENCE == 0:
            found = [other]
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
    return abs(float(a @ b)) <= _APART * float(np.linalg.norm(a) * np.linalg.norm(b))


class Setup(NamedTuple):
    """One measurement campaign, of which several cases are made.

    Attributes:
        bench: the sound law, and what the twin can fit.
        families: what can be wrong.
        write: (folder, measurements (block, row), families left out, seed of the diagnosis) writes a case.
        more: what else the key tells.
    """

    bench: Bench
    families: Families
    write: Callable[[Path, Vector, Sequence[str], int], None]
    more: Mapping[str, Any]


def make_case(out: Path, order: Order, setup: Setup) -> dict[str, Any]:
    """Write one case.

    Args:
        out: folder of the study.
        order: what is asked for.
        setup: the campaign.

    Returns:
        The case's record.
    """
    choice, law = choose(order.rng, order.kind, setup.bench, order.lambda_, setup.families), setup.bench.law
    for one in choice.faults:
        law = one.fault.change(law, one.size)
    measured = measure(np.random.default_rng([order.seed, order.index, 2]), law)
    setup.write(out / "cases" / order.name, measured, choice.excluded, order.index)
    return order.record([one.record() for one in choice.faults], choice.excluded, **setup.more)
