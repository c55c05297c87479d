"""What all tracks of withheld cases share: checks of what is asked for, and the key."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dtprob.errors import InputError, unknown_name
from dtprob.files import atomic_write


def checked(
    kinds: Sequence[str],
    lambda_: float | Sequence[float],
    families: Sequence[str],
    *,
    known_kinds: Iterable[str],
    known_families: Iterable[str],
) -> tuple[float, ...]:
    """The values of lambda, once everything asked for is known to exist.

    Args:
        kinds: of cases.
        lambda_: one or more.
        families: of effects.
        known_kinds: that the track makes.
        known_families: that it has.

    Raises:
        InputError: an unknown kind or family, nothing asked for, or a lambda that is not positive.
    """
    for kind in kinds:
        if kind not in known_kinds:
            raise unknown_name("kinds", kind, known_kinds, "kind")
    for family in families:
        if family not in known_families:
            raise unknown_name("families", family, known_families, "family")
    lambdas = (float(lambda_),) if isinstance(lambda_, int | float) else tuple(map(float, lambda_))
    if not kinds or not families or not lambdas or min(lambdas) <= 0:
        got = f"{len(kinds)} kinds, {len(families)} families, lambda {lambdas}"
        raise InputError("withheld cases", "kinds, families and positive values of lambda", got, "Give them")
    return lambdas


def write_key(
    out: Path, count: int, seed: int, *, track: str, convention: str, plan: Mapping[str, Any]
) -> Path:
    """Gather the records of all cases, `truth/NNNN.json`, into the key.

    Args:
        out: folder of the study.
        count: number of cases.
        seed: from which they were drawn.
        track: kind of twin.
        convention: what lambda means.
        plan: settings of the campaigns.

    Returns:
        The key's file.
    """
    records = (out / "truth" / f"{index:04d}.json" for index in range(count))
    key = {
        "format": "dtprob.withheld",
        "version": 1,
        "track": track,
        "seed": seed,
        "convention": convention,
        "plan": dict(plan),
        "cases": [json.loads(record.read_text(encoding="utf-8")) for record in records],
    }
    with atomic_write(out / "key.json") as temporary:
        temporary.write_text(json.dumps(key, indent=1), encoding="utf-8")
    return out / "key.json"
