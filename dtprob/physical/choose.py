"""Which effects a withheld case has, and of what size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from dtprob.errors import InputError
from dtprob.physical.bench import Bench
from dtprob.physical.campaign import Site
from dtprob.physical.draws import FAMILIES, draw
from dtprob.physical.impairment import Impairment

KINDS: Final = ("null", "listed", "unlisted", "pair", "triple", "alias")
"""Of cases."""

FOREIGN: Final = ("beam_squint", "correlated_noise", "dispersive_walls", "pedestrian")
"""Families that no library of effects has."""
LISTED: Final = tuple(name for name in FAMILIES if name not in FOREIGN)
APART: Final = 0.5
"""Effects of one case correlate less than this in what the twin's free parameters cannot mimic."""
TAKEN_OUT: Final = 2 / 3
"""Share of the unlisted causes whose family is taken out of the library; the others never had an entry."""
_TRIES: Final = 60
_TOLERANCE: Final = 0.15
_POOL: Final = 12
_PROBE: Final = 1e-4
"""Size, over the limit, at which correlations for aliases are taken."""


@dataclass(frozen=True)
class Active:
    """An impairment in a case.

    Attributes:
        impairment: what.
        size: how large.
        lambda_: how informative, alone.
    """

    impairment: Impairment
    size: float
    lambda_: float

    def record(self) -> dict[str, Any]:
        """For the key."""
        one = self.impairment
        return {
            "name": one.name,
            "family": one.family,
            "instance": one.instance,
            "size": self.size,
            "unit": one.unit,
            "lambda": self.lambda_,
            "detail": dict(one.detail),
        }


@dataclass(frozen=True)
class Choice:
    """What a case holds.

    Attributes:
        effects: the impairments.
        excluded: families taken out of the library for this case.
        alias: name of an effect that looks much like the true one, and their correlation.
    """

    effects: tuple[Active, ...] = ()
    excluded: tuple[str, ...] = ()
    alias: tuple[str, float] | None = None


def choose(rng: np.random.Generator, kind: str, site: Site, target: float, families: Sequence[str]) -> Choice:
    """The effects of a case.

    Args:
        rng: source of randomness.
        kind: of case.
        site: where it is measured.
        target: lambda of each effect alone.
        families: from which effects are drawn.

    Raises:
        InputError: nothing that fits was found.
    """
    if kind == "null":
        return Choice()
    if kind == "listed":
        return Choice((_sized(rng, site, target, families),))
    if kind == "unlisted":
        if rng.random() < 1 - TAKEN_OUT:
            return Choice((_sized(rng, site, target, FOREIGN),))
        one = _sized(rng, site, target, families)
        return Choice((one,), excluded=(one.impairment.family,))
    if kind == "alias":
        return _aliased(rng, site, target, families)
    return Choice(_several(rng, site, target, families, 2 if kind == "pair" else 3))


def _sized(rng: np.random.Generator, site: Site, target: float, families: Sequence[str]) -> Active:
    """One effect of the right information."""
    for _ in range(_TRIES):
        impairment = draw(rng, str(rng.choice(np.asarray(families))), site.setting)
        active = _scaled(site.bench, impairment, target) if impairment else None
        if active:
            return active
    raise InputError(
        "withheld case", f"an effect of lambda {target:g}", "none", "Ask for less, or more links"
    )


def _scaled(bench: Bench, impairment: Impairment, target: float) -> Active | None:
    try:
        size, found = bench.size_for(impairment, target)
    except InputError:
        return None
    close = abs(found / target - 1) <= _TOLERANCE
    return Active(impairment, size, found) if close else None


def _several(
    rng: np.random.Generator, site: Site, target: float, families: Sequence[str], count: int
) -> tuple[Active, ...]:
    """Effects of different families that can be told apart; at most one of them is random or on the noise."""
    found: list[Active] = []
    for _ in range(_TRIES):
        one = _sized(rng, site, target, families)
        if all(_apart(site.bench, one, other) for other in found):
            found.append(one)
        if len(found) == count:
            return tuple(found)
    raise InputError(
        "withheld case", f"{count} effects that can be told apart", "fewer", "Name more families"
    )


def _apart(bench: Bench, one: Active, other: Active) -> bool:
    if one.impairment.family == other.impairment.family:
        return False
    if not (_shifts_mean(one.impairment) or _shifts_mean(other.impairment)):
        return False
    stages = (one.impairment.synthesis, other.impairment.synthesis)
    if all(stages):
        return False
    if not (_shifts_mean(one.impairment) and _shifts_mean(other.impairment)):
        return True
    seen = [bench.visible(active.impairment, active.size) for active in (one, other)]
    return abs(correlation(*seen)) < APART


def _shifts_mean(impairment: Impairment) -> bool:
    return impairment.noise is None and impairment.spread is None


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Cosine of the angle between two vectors; 0 where one of them is 0."""
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 0 else 0.0


def _aliased(rng: np.random.Generator, site: Site, target: float, families: Sequence[str]) -> Choice:
    """One effect, chosen because another one of the families looks like it."""
    pool: list[Impairment] = []
    for family in rng.permutation(np.asarray(families)):
        one = draw(rng, str(family), site.setting)
        if one and _shifts_mean(one):
            pool.append(one)
    pool = pool[:_POOL]
    seen = [site.bench.visible(one, _PROBE * one.limit) for one in pool]
    pairs = sorted(
        ((abs(correlation(seen[i], seen[j])), i, j) for i in range(len(pool)) for j in range(i)), reverse=True
    )
    for similar, i, j in pairs:
        for true, other in ((i, j), (j, i)):
            active = _scaled(site.bench, pool[true], target)
            if active:
                return Choice((active,), alias=(pool[other].name, similar))
    raise InputError(
        "withheld case", f"an effect of lambda {target:g}", "none", "Ask for less, or more links"
    )
