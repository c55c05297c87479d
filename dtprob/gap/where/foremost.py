"""Which entry of a site family stands out: the group, the row or the output that brings most of what is wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from scipy import stats

from dtprob.gap.where.families import Site
from dtprob.gap.where.family_test import FamilyTest
from dtprob.raytracing.paths import path_set_among

_MOST: Final = 0.6
"""Share of what is more than chance that an entry has to bring; of two groups each brings a half."""
_CHANCE: Final = 0.01
"""Probability up to which the largest of so many entries may be that large by chance."""


type Names = Mapping[str, Sequence[str]]
"""What the entries along an axis are called."""


def names_of_entries(data: Mapping[str, Any]) -> Names:
    """Of the objects of a traced scene in a model's data; of no other axis."""
    traced = path_set_among(data)
    return {} if traced is None else {"object": traced.object_names}


def foremost(
    named: FamilyTest, tests: Sequence[FamilyTest], site: Site, names: Names = MappingProxyType({})
) -> str | None:
    """The place of the entry that brings most of what is wrong, in words; None where several do, or where it has none.

    One far reading shows in every ripple, so that where the family that is named has no such entry, single ones are asked,
    if these are wrong by themselves: of thousands of readings the farthest one is far, and of rare outcomes very far.

    Args:
        named: the test of the family that is named.
        tests: of all families of the site.
        site: that they perturb.
        names: by which entries are told instead of by their numbers.
    """
    kind, whole = named.family.kind, _excess(named)
    single = (
        t for t in tests if t.family.kind == kind and t.family.pattern.curves is None and t.p_value <= _CHANCE
    )
    found = (
        _entry(test, site, whole, names) for test in (named, *sorted(single, key=lambda t: -len(t.variance)))
    )
    return next((place for place in found if place is not None), None)


def _excess(test: FamilyTest) -> float:
    """What a family tells more than chance does; of curves that overlap the best one, since the same is in many."""
    curves, excess = test.family.pattern.curves, test.told - test.seen
    if curves is None or not curves.overlaps:
        return float(excess.sum())
    return float(excess.reshape(curves.extent[0], -1).sum(axis=1).max())


def _entry(test: FamilyTest, site: Site, whole: float, names: Names) -> str | None:
    """The entry of one family that brings most of its excess and of the whole one, that of the family that is named."""
    curves = test.family.pattern.curves
    if curves is not None and (curves.overlaps or not curves.places):
        return None
    parts = 2 if np.iscomplexobj(site.value) else 1
    told, seen = (entries.reshape(-1, parts).sum(axis=1) for entries in (test.told, test.seen))
    top, excess = int(told.argmax()), told - seen
    by_chance = len(told) * stats.chi2.sf(told[top], max(int(seen[top]), 1))
    if len(told) < 2 or excess[top] < _MOST * max(float(excess.sum()), whole) or by_chance > _CHANCE:
        return None
    return _words(test, site, top, len(told), names)


def _words(test: FamilyTest, site: Site, entry: int, count: int, names: Names) -> str:
    """An entry by its group and its positions along the axes that have weights of their own."""
    pattern, words = test.family.pattern, []
    axes = list(pattern.kept)
    if pattern.curves is not None:
        each = count // len(pattern.curves.places)
        words, entry = [pattern.curves.places[entry // each]], entry % each
        while axes and np.prod([site.value.shape[i] for i in axes]) > each:
            axes.pop(0)  # the curves run along the first ones
    place = np.unravel_index(entry, [site.value.shape[i] for i in axes]) if axes else ()
    wide = [(i, n) for i, n in zip(axes, place, strict=True) if site.value.shape[i] > 1]
    return ", ".join([*words, *(f"{site.axes[i]} {_called(site, i, int(n), names)}" for i, n in wide)])


def _called(site: Site, axis: int, position: int, names: Names) -> str:
    """The name of a position along an axis, its number where there is none."""
    found = names.get(site.axes[axis], ())
    return found[position] if len(found) == site.value.shape[axis] else str(position)
