"""What tracks of faulty Gaussian measurements share: which faults a case has, and how cases and records are written."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from dtprob.errors import InputError
from dtprob.files import atomic_write
from dtprob.physical.gaussian import Bench, Fault, Sized, Vector, measure, sized, visible

KINDS: Final = ("null", "listed", "unlisted", "pair", "triple")
SHARED: Final = 8
"""Cases of one campaign."""
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


@dataclass(frozen=True)
class Study:
    """Which cases are asked for.

    Attributes:
        count: how many.
        seed: from which everything is drawn.
        kinds: of cases, in turn.
        lambdas: information of each fault alone, drawn from these.
    """

    count: int
    seed: int
    kinds: Sequence[str]
    lambdas: Sequence[float]


def generate(
    out: Path,
    study: Study,
    make: Callable[[np.random.Generator, int], Setup],
    *,
    resume: bool,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Write the cases of a study, each with its record last.

    Args:
        out: folder of the study.
        study: what is asked for.
        make: (rng, number of the campaign) -> the campaign.
        resume: keep the cases that are whole.
        progress: called with the number of cases done and of all.
    """
    for index in range(study.count):
        name, draws = f"{index:04d}", (study.seed, index)
        if not (resume and (out / "truth" / f"{name}.json").is_file()):
            number = index // SHARED
            setup = make(np.random.default_rng([study.seed, number, 0]), number)
            rng, kind = np.random.default_rng([*draws, 1]), study.kinds[index % len(study.kinds)]
            target = study.lambdas[int(rng.integers(len(study.lambdas)))]
            choice, law = choose(rng, kind, setup.bench, target, setup.families), setup.bench.law
            for one in choice.faults:
                law = one.fault.change(law, one.size)
            measured = measure(np.random.default_rng([*draws, 2]), law)
            setup.write(out / "cases" / name, measured, choice.excluded, index)
            record = {
                "name": name,
                "kind": kind,
                "lambda": target if choice.faults else 0.0,
                "effects": [one.record() for one in choice.faults],
                "excluded": list(choice.excluded),
                "alias": None,
                **setup.more,
            }
            write_text(out / "truth" / f"{name}.json", json.dumps(record, indent=1))
        if progress:
            progress(index + 1, study.count)


def left_out(excluded: Sequence[str]) -> str:
    """The line of a CASE's [effects] that leaves some out; nothing where there are none."""
    return f"exclude = {json.dumps(list(excluded))}\n" if excluded else ""


def write_text(file: Path, text: str) -> None:
    """Write a text file whole."""
    with atomic_write(file) as temporary:
        temporary.write_text(text, encoding="utf-8")
