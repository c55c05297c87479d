"""How a site that is surely wrong may vary: the families that bring evidence as random weights of a common spread."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from dtprob.gap.where.curves import Curves
from dtprob.gap.where.families import Family, Pattern, Site
from dtprob.gap.where.family_test import FamilyTest
from dtprob.gap.which.fields import common_spread, spread_terms

_MOST_SUSPECTS: Final = 12
_MOST_WEIGHTS: Final = 4096
"""Suspects of a site that are kept, and weights that one of them may have."""
_NEARLY: Final = 0.8
_FEW: Final = 16
"""Share of the surest family's log p-value, and of its evidence, that another one has at least where it may be named
instead; and its weights where curves overlap."""
_SHOWN: Final = 3.0
"""Nats that a way of saying it more plainly shows by itself at least."""
_FARTHEST: Final = 1e-20
"""p-value below which all are as sure: replicates give a few weights a longer tail than hundreds."""


@dataclass(frozen=True)
class Suspect:
    """A way of varying a surely wrong site, with random weights of a common spread.

    Attributes:
        site: its name.
        rows: of an observation, its whitened components that move; None for a deterministic site.
        family: what is added to the site, and how it varies.
        spread: standard deviation of the weights with the largest evidence.
        evidence: log Bayes factor of that spread against none, to first order, each weight apart.
        steady: the same if the site's scores scatter as much as they do in the data, which what is wrong elsewhere makes
            them: the order in which ways of varying a site are looked at.
        price: logarithm of how many ways of varying the site it was picked from.
    """

    site: str
    rows: tuple[int, ...] | None
    family: Family
    spread: float
    evidence: float
    steady: float
    price: float


def suspects(site: Site, tests: Sequence[FamilyTest]) -> list[Suspect]:
    """The families of a site that have the most evidence, those of many bands or places also narrowed to the best."""
    # no parameter that all distributions have moves their shape
    moved = [test for test in tests if test.family.kind != "shape" and test.variance.size <= _MOST_WEIGHTS]
    choice = float(np.log(max(len(moved), 1)))
    scatter = {kind: _scatter(tests, kind) for kind in {test.family.kind for test in moved}}
    one = functools.partial(_suspect, site, scatter, choice)
    found = [one(test) for test in moved if _overlapping(test.family.pattern) is None]
    found += [one(narrow, band) for test in moved for narrow, band in _narrowed(test)]
    ordered = sorted((suspect for suspect in found if suspect is not None), key=lambda s: -s.steady)
    # of entries by themselves the scatter is what they say
    each = [i for i, s in enumerate(ordered) if s.family.pattern.curves is None]
    most = max(each, key=lambda i: ordered[i].evidence, default=0)
    kept = ordered[:_MOST_SUSPECTS]
    return kept if most < _MOST_SUSPECTS else [*kept[:-1], ordered[most]]


def _scatter(tests: Sequence[FamilyTest], kind: str) -> float:
    """Squared scores of a site's entries over their variance, on average; at least 1.

    A spread that is wrong by a factor, or a few far readings, make the scores of all families larger than replicates know.
    Random weights would have more evidence the more of them there are, whatever they follow.
    """
    each = [t for t in tests if t.family.kind == kind and t.family.pattern.curves is None]
    finest = max(each, key=lambda t: len(t.variance), default=None)
    if finest is None or not finest.seen.any():
        return 1.0
    return max(float(finest.told[finest.seen].mean()), 1.0)


def plainest(surest: FamilyTest, tests: Sequence[FamilyTest]) -> FamilyTest:
    """The surest of a site's families, or one that says it in plainer words and is nearly as sure and as evident.

    Curves that overlap are tested together: what varies along another column shows in many of them, so that the most
    evident of them and of the families of few weights is named, over a column of the data sooner than over what the model
    computes. What varies over positions (a ripple, a cycle, each position by itself) is told by the column that it follows,
    where there is one.
    """
    evidence = functools.partial(_evidence, scatter=_scatter(tests, surest.family.kind))
    pattern, most = surest.family.pattern, _NEARLY * np.log(max(surest.p_value, _FARTHEST))
    alike = [t for t in tests if t.family.kind == surest.family.kind and np.log(t.p_value) <= most]
    if _overlapping(pattern) is not None:
        few = [t for t in alike if len(t.variance) <= _FEW or _overlapping(t.family.pattern) is not None]
        best = max(few, key=evidence)
        told = max((t for t in few if _is_of_data(t.family.pattern)), key=evidence, default=best)
        return told if evidence(told) >= max(_NEARLY * evidence(best), _SHOWN) else best
    if pattern.kept and not _is_plain(pattern):
        plain = max((t for t in alike if _is_plain(t.family.pattern)), key=evidence, default=surest)
        return plain if evidence(plain) >= max(_NEARLY * evidence(surest), _SHOWN) else surest
    return surest


def _evidence(test: FamilyTest, scatter: float) -> float:
    """Log Bayes factor of random weights of a family, of the best place alone where its curves overlap."""
    curves = _overlapping(test.family.pattern)
    if curves is None:
        return common_spread(test.first[0], scatter * test.variance)[1]
    place, chances = _at_best_place(test, curves)
    return common_spread(place.first[0], scatter * place.variance)[1] - chances


def _at_best_place(test: FamilyTest, curves: Curves) -> tuple[FamilyTest, float]:
    """A family of curves that overlap with the one that has most evidence, and the logarithm of how many there are."""
    count, _ = curves.extent
    each = len(test.variance) // count
    own = [slice(start, start + each) for start in range(0, count * each, each)]
    best = int(np.argmax([common_spread(test.first[0][one], test.variance[one])[1] for one in own]))
    only = replace(curves, label=curves.places[best], values=curves.values[[best]], overlaps=False, places=())
    family = replace(test.family, pattern=replace(test.family.pattern, label=only.label, curves=only))
    place = test._replace(family=family, first=test.first[:, own[best]], variance=test.variance[own[best]])
    return place, float(np.log(count))


def _is_plain(pattern: Pattern) -> bool:
    """Whether a pattern follows a column."""
    return pattern.curves is not None and pattern.curves.plain


def _is_of_data(pattern: Pattern) -> bool:
    """Whether a pattern follows columns of the data, or nothing, and not what the model computes or mere positions."""
    return pattern.curves is None or pattern.curves.of_data


def _overlapping(pattern: Pattern) -> Curves | None:
    """A pattern's curves where they tell the same many times over, so that their evidence would be, too."""
    return pattern.curves if pattern.curves is not None and pattern.curves.overlaps else None


def _narrowed(test: FamilyTest) -> Iterator[tuple[FamilyTest, float]]:
    """Of ripples the band of 1, 2, 4 ... half waves with the most evidence, of curves that overlap the best one.

    Each with the logarithm of how many there were.
    """
    pattern = test.family.pattern
    if (curves := _overlapping(pattern)) is not None:
        yield _at_best_place(test, curves)
    if pattern.curves is None or pattern.curves.ripple is None:
        return
    count, _ = pattern.curves.extent
    if count == 1:
        return
    _, terms = spread_terms(test.first[0], test.variance)
    summed = np.cumsum(terms.reshape(len(terms), count, -1).sum(-1), axis=1)
    summed = np.concatenate([np.zeros((len(terms), 1)), summed], axis=1)
    lengths = 2 ** np.arange(int(np.log2(count)))
    tops = [(summed[:, n:] - summed[:, :-n]).max(axis=0) for n in lengths]
    top = max(range(len(tops)), key=lambda i: tops[i].max())
    first = int(tops[top].argmax())
    best = first, first + int(lengths[top])
    band = pattern.curves.band(*best)
    narrow = replace(test.family, pattern=replace(pattern, label=band.label, curves=band))
    parts = len(test.variance) // count
    own = slice(best[0] * parts, best[1] * parts)
    chances = sum(map(len, tops))
    yield (
        test._replace(family=narrow, first=test.first[:, own], variance=test.variance[own]),
        float(np.log(chances)),
    )


def _suspect(
    site: Site, scatter: Mapping[str, float], choice: float, test: FamilyTest, band: float = 0.0
) -> Suspect | None:
    """A tested family as a suspect, if its evidence less the price of its band speaks for it."""
    spread, evidence = common_spread(test.first[0], test.variance)
    if evidence <= band:
        return None
    steady = common_spread(test.first[0], scatter[test.family.kind] * test.variance)[1] - band
    return Suspect(site.name, site.rows, test.family, spread, evidence - band, steady, choice + band)
