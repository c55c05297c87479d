"""What tracks of faulty Gaussian measurements share: which faults a case has, and how it is written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from dtprob.errors import InputError
from dtprob.physical.cells import touched
from dtprob.physical.gaussian import Bench, Fault, Law, Sized, Vector, measure, sized, visible
from dtprob.physical.study import Order

KINDS: Final = ("null", "listed", "unlisted", "pair", "triple", "alias")
_TAKEN_OUT: Final = 0.5
"""Share of the unlisted causes whose family is taken out of the library; the others never had an entry."""
_TRIES: Final = 60
_PATIENCE: Final = 8
"""Faults that may be too much like the others before these are drawn anew."""
_POOL: Final = 16
"""Faults among which an alias is looked for."""
_PROBE: Final = 0.02
"""Size, over the limit, at which faults are compared."""
_APART: Final = 0.5
"""Faults of one case correlate less than this in what the twin cannot imitate."""


class Choice(NamedTuple):
    """The faults of a case, the families that it takes out of the library, and what looks much like the true fault."""

    faults: tuple[Sized, ...] = ()
    excluded: tuple[str, ...] = ()
    alias: Mapping[str, Any] | None = None


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
    if kind == "unlisted" and rng.random() < 1 - _TAKEN_OUT:
        return Choice((_one(rng, bench, target, families, families.foreign),))
    if kind == "alias":
        return _aliased(rng, bench, target, families)
    if kind == "unlisted":
        one = _one(rng, bench, target, families, families.known)
        return Choice((one,), (one.fault.family,))
    return Choice(_several(rng, bench, target, families, {"listed": 1, "pair": 2, "triple": 3}[kind]))


def _several(
    rng: np.random.Generator, bench: Bench, target: float, families: Families, count: int
) -> tuple[Sized, ...]:
    """Faults of different families that can be told apart."""
    found = [_one(rng, bench, target, families, families.known)]
    for attempt in range(1, _TRIES):
        if len(found) == count:
            return tuple(found)
        fault = _drawn(rng, families, families.known)
        other = _sized(bench, fault, target) if _apart(bench, fault, found) else None
        if other is not None:
            found.append(other)
        elif attempt % _PATIENCE == 0:
            found = [_one(rng, bench, target, families, families.known)]
    raise InputError("withheld case", f"{count} faults that can be told apart", "fewer", "Name more families")


def _one(
    rng: np.random.Generator, bench: Bench, target: float, families: Families, names: Sequence[str]
) -> Sized:
    for _ in range(_TRIES):
        found = _sized(bench, _drawn(rng, families, names), target)
        if found is not None:
            return found
    raise InputError("withheld case", f"a fault of lambda {target:g}", "none", "Ask for less")


def _drawn(rng: np.random.Generator, families: Families, names: Sequence[str]) -> Fault:
    if not names:
        raise InputError("withheld case", "families that its campaign has", "none", "Name more families")
    return families.draw(rng, str(rng.choice(np.asarray(names))))


def _sized(bench: Bench, fault: Fault, target: float) -> Sized | None:
    try:
        return sized(bench, fault, target)
    except InputError:
        return None


def _apart(bench: Bench, fault: Fault, others: Sequence[Sized]) -> bool:
    """Whether a fault, small, looks unlike all others."""
    if fault.family in {other.fault.family for other in others}:
        return False
    seen = _seen(bench, fault)
    return all(_alike(seen, _seen(bench, other.fault)) <= _APART for other in others)


def _seen(bench: Bench, fault: Fault) -> np.ndarray:
    """What can be seen of a small fault."""
    return visible(bench, fault.change(bench.law, _PROBE * fault.limit))


def _alike(a: np.ndarray, b: np.ndarray) -> float:
    """Size of the cosine of the angle between two vectors; 0 where one of them is 0."""
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return abs(float(a @ b)) / norm if norm > 0 else 0.0


def _aliased(rng: np.random.Generator, bench: Bench, target: float, families: Families) -> Choice:
    """Of several faults the one that looks most like another one of them, be it of the same family."""
    drawn = [_drawn(rng, families, families.known) for _ in range(_POOL)]
    pool = list({fault.name: fault for fault in drawn}.values())
    seen = [_seen(bench, fault) for fault in pool]
    pairs = [(_alike(seen[i], seen[j]), i, j) for i in range(len(pool)) for j in range(len(pool)) if i != j]
    for similar, true, other in sorted(pairs, reverse=True):
        found = _sized(bench, pool[true], target)
        if found is not None:
            return Choice((found,), alias={"name": pool[other].name, "correlation": similar})
    raise InputError("withheld case", f"faults that look alike, of lambda {target:g}", "none", "Ask for less")


class Setup(NamedTuple):
    """One measurement campaign, of which several cases are made.

    Attributes:
        bench: the sound law, and what the twin can fit.
        families: what can be wrong.
        write: (folder, measurements (block, row), families left out, seed of the diagnosis) writes a case.
        axes: names of (block, row) in the twin, or of both run together.
        unordered: those of them whose neighbours have nothing to do with each other.
        more: what else the key tells.
    """

    bench: Bench
    families: Families
    write: Callable[[Path, Vector, Sequence[str], int], None]
    axes: Sequence[str]
    unordered: Sequence[str]
    more: Mapping[str, Any]

    def cells(self, law: Law, lambda_: float) -> dict[str, list[int]]:
        """What a law with faults of this information touches; see `touched`."""
        seen = visible(self.bench, law) ** 2
        blocks, rows = self.bench.law.mean.shape
        mean, pairs = np.split(seen, [blocks * rows])
        energy = mean.reshape(blocks, rows) + pairs.reshape(blocks, rows, rows).sum(axis=2)
        cells = energy.reshape(-1) if len(self.axes) == 1 else energy
        return touched(cells, self.axes, lambda_, self.unordered)


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
    effects = [one.record() for one in choice.faults]
    left_out = order.left_out(choice.excluded, [*effects, choice.alias], setup.families.known, _TAKEN_OUT)
    setup.write(out / "cases" / order.name, measured, left_out, order.index)
    return order.record(
        effects,
        left_out,
        choice.alias,
        cells=setup.cells(law, sum(one.lambda_ for one in choice.faults)),
        **setup.more,
    )
