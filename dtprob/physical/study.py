"""What all tracks of withheld cases share: the loop over the cases, their records, the key.

A study is a folder: what a diagnosis may read lies in `cases/NNNN`; what is true of each case lies apart, in
`truth/NNNN.json` and, gathered, in `key.json`; `study.json` says what was asked for.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from dtprob.errors import InputError, unknown_name
from dtprob.files import write_text

SHARED: Final = 8
"""Cases of one campaign: the same site, network or survey, with the same unknowns."""
_CAMPAIGNS: Final = 4
"""Campaigns that are tried for a case before it is given up."""
LAMBDAS: Final = (25.0, 100.0, 400.0)


@dataclass(frozen=True)
class Order:
    """One case that is asked for.

    Attributes:
        index: number of the case.
        seed: of the study; sources of randomness of the case begin with `(seed, index)`.
        kind: "null" nothing wrong, "listed" one effect, "unlisted" one whose family the case takes out of the library, or
            that never had an entry, "pair" and "triple" several that can be told apart, "alias" one that looks much like
            another of the library.
        lambda_: information that each effect carries alone.
        families: which effects may occur.
        rng: source of randomness of what is chosen.
    """

    index: int
    seed: int
    kind: str
    lambda_: float
    families: Sequence[str]
    rng: np.random.Generator

    @property
    def name(self) -> str:
        """Of the case's folder and record."""
        return f"{self.index:04d}"

    def left_out(
        self,
        excluded: Sequence[str],
        there: Iterable[Mapping[str, Any] | None],
        known: Sequence[str],
        share: float,
    ) -> tuple[str, ...]:
        """Families that the case takes out of the library: those of an unlisted cause, or as often an innocent one.

        Otherwise a case would tell its kind.

        Args:
            excluded: families of the cause.
            there: records of the case's effects, and of what looks like them, if anything does; their families stay.
            known: families that the library has.
            share: of the unlisted cases whose family is taken out.
        """
        if excluded or self.kind == "unlisted":
            return tuple(excluded)
        rng = np.random.default_rng([self.seed, self.index, 9])
        families = {str(one["name"]).split("[")[0] for one in there if one}
        innocent = [family for family in known if family not in families]
        return (str(rng.choice(innocent)),) if innocent and rng.random() < share else ()

    def record(
        self,
        effects: Sequence[Mapping[str, Any]],
        excluded: Sequence[str],
        alias: Mapping[str, Any] | None = None,
        **more: Any,
    ) -> dict[str, Any]:
        """What the key tells of the case.

        Args:
            effects: what is wrong.
            excluded: families that the case takes out of the library.
            alias: an effect that looks much like the true one.
            **more: what else there is to tell.
        """
        return {
            "name": self.name,
            "kind": self.kind,
            "lambda": self.lambda_ if effects else 0.0,
            "effects": list(effects),
            "excluded": list(excluded),
            "alias": alias,
            **more,
        }


@dataclass(frozen=True)
class Track[C]:
    """How the cases of one kind of twin are made.

    Attributes:
        name: of the track.
        convention: what lambda means.
        kinds: of cases that it makes.
        usual: those that it makes unless told otherwise.
        families: of effects that it has.
        listed: those of them that the library has.
        plan: settings of the campaigns, for the key.
        campaign: (rng, number, families) -> a campaign.
        case: (folder of the study, order, campaign) -> the case's record, once its files are written.
    """

    name: str
    convention: str
    kinds: Sequence[str]
    usual: Sequence[str]
    families: Sequence[str]
    listed: Sequence[str]
    plan: Mapping[str, Any]
    campaign: Callable[[np.random.Generator, int, Sequence[str]], C]
    case: Callable[[Path, Order, C], Mapping[str, Any]]

    def generate(
        self,
        out: Path,
        count: int,
        seed: int,
        kinds: Sequence[str] | None = None,
        lambda_: float | Sequence[float] = LAMBDAS,
        *,
        families: Sequence[str] | None = None,
        resume: bool = False,
        progress: Callable[[int, int], None] | None = None,
    ) -> Path:
        """Write withheld cases and their key.

        Case i is of kind `kinds[i % len(kinds)]`; its lambda is drawn from those given. Everything is drawn from the seed
        and the number of the case.

        Args:
            out: folder of the study.
            count: number of cases.
            seed: from which everything is drawn.
            kinds: of cases; see `Order`. The track's usual ones where None.
            lambda_: information that each effect carries alone; one or more.
            families: which effects may occur; those of the library where None.
            resume: keep the cases that are whole.
            progress: called with the number of cases done and `count`.

        Returns:
            The key's file.

        Raises:
            InputError: an unknown kind or family, nothing asked for, a lambda that is not positive or that no effect
                of several campaigns can reach, or a folder that holds another study.
        """
        kinds = self.usual if kinds is None else kinds
        families = self.listed if families is None else families
        lambdas = (float(lambda_),) if isinstance(lambda_, int | float) else tuple(map(float, lambda_))
        self._check(kinds, families, lambdas)
        self._begin(
            out, {"seed": seed, "kinds": [*kinds], "lambdas": lambdas, "families": [*families]}, resume=resume
        )

        @lru_cache(maxsize=2)
        def campaign(number: int, again: int) -> C:
            rng = np.random.default_rng([seed, number, 0, again] if again else [seed, number, 0])
            return self.campaign(rng, number, families)

        def case(order: Order) -> Mapping[str, Any]:
            for again in range(_CAMPAIGNS - 1):
                with suppress(InputError):  # there is no such effect in this campaign
                    return self.case(out, order, campaign(order.index // SHARED, again))
            return self.case(out, order, campaign(order.index // SHARED, _CAMPAIGNS - 1))

        for index in range(count):
            record = out / "truth" / f"{index:04d}.json"
            if not (resume and record.is_file()):
                rng = np.random.default_rng([seed, index, 1])
                size = lambdas[int(rng.integers(len(lambdas)))]
                order = Order(index, seed, kinds[index % len(kinds)], size, families, rng)
                write_text(record, json.dumps(case(order), indent=1))  # last: the sign that the case is whole
            if progress:
                progress(index + 1, count)
        return self._write_key(out, count, seed)

    def _check(self, kinds: Sequence[str], families: Sequence[str], lambdas: Sequence[float]) -> None:
        _check_names("kinds", kinds, self.kinds, "kind")
        _check_names("families", families, self.families, "family")
        if not kinds or not families or not lambdas or not all(0 < one < np.inf for one in lambdas):
            got = f"{len(kinds)} kinds, {len(families)} families, lambda {lambdas}"
            raise InputError(
                "withheld cases", "kinds, families and positive values of lambda", got, "Give them"
            )

    def _begin(self, out: Path, asked: Mapping[str, Any], *, resume: bool) -> None:
        """Write what the study is, or see that what lies there is part of the same one."""
        file, whole = out / "study.json", {"track": self.name, "plan": dict(self.plan), **asked}
        text = json.dumps(whole, indent=1)
        begun = (out / "truth").is_dir() or file.is_file()
        if resume and begun and not (file.is_file() and file.read_text(encoding="utf-8") == text):
            expected = f"a folder without cases, or with cases of seed {asked['seed']} and the same settings"
            raise InputError(
                f"{out}", expected, "cases of another study", "Give another folder, or empty this one"
            )
        write_text(file, text)

    def _write_key(self, out: Path, count: int, seed: int) -> Path:
        """Gather the records of all cases."""
        records = [out / "truth" / f"{index:04d}.json" for index in range(count)]
        key = {
            "format": "dtprob.withheld",
            "version": 1,
            "track": self.name,
            "seed": seed,
            "convention": self.convention,
            "plan": dict(self.plan),
            "cases": [
                {
                    **json.loads(record.read_text(encoding="utf-8")),
                    "sha256": _hashes(out / "cases" / record.stem),
                }
                for record in records
            ],
        }
        write_text(out / "key.json", json.dumps(key, indent=1))
        return out / "key.json"


def _hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of a case, so that a key proves which cases it belongs to."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def _check_names(what: str, asked: Iterable[str], known: Sequence[str], noun: str) -> None:
    for name in asked:
        if name not in known:
            raise unknown_name(what, name, known, noun)


def case_end(excluded: Sequence[str], seed: int, use: str | Sequence[str] = "all") -> str:
    """The last sections of a CASE: effects, engine and seed, as TOML.

    Args:
        excluded: families of effects that it leaves out.
        seed: of the diagnosis.
        use: effects that it offers: "all", names, or a place in a module.
    """
    left_out = f"exclude = {json.dumps(list(excluded))}\n" if excluded else ""
    used = json.dumps(use if isinstance(use, str) else list(use))
    return f"""[effects]
use = {used}
{left_out}
[engine]
name = "laplace"

[seed]
value = {seed}
"""
