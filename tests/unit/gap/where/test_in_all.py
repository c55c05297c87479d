"""P-values over many families: half the level is the simple ones' own, and together they are as rare as they say."""

from typing import Any, cast

import numpy as np
import pytest
from scipy import stats

from dtprob.gap.where.curves import Curves, by_group, over_column, stretches
from dtprob.gap.where.families import Family, Pattern
from dtprob.gap.where.family_test import FamilyTest
from dtprob.gap.where.in_all import InAll

SIMPLE = Family("additive", Pattern("common", ()), np.ones(()))
OTHER = Family("additive", Pattern("every 2", (0,), Curves("every 2", np.eye(4))), np.ones(()))


def made(simple, other):
    """Tests of so many families, from p-values (data and replicates, family) of both kinds."""
    return [
        FamilyTest(family, float(p[0]), p[1:], cast("Any", None), cast("Any", None))
        for family, every in ((SIMPLE, simple), (OTHER, other))
        for p in every.T
    ]


@pytest.mark.parametrize(("few", "many"), [(5, 2000), (20, 20), (0, 300), (30, 0)])
def test_the_smallest_is_as_rare_as_it_says(few, many):
    rng, found = np.random.default_rng(few), []
    for _ in range(600):
        tests = made(rng.uniform(size=(200, few)), rng.uniform(size=(200, many)))
        in_all = InAll.of(tests)
        found.append(min(in_all.p_value(test) for test in tests))
    for level in (0.01, 0.05, 0.2):
        hits = (np.array(found) <= level).sum()  # half of the level is kept back
        assert hits <= stats.binom.isf(1e-4, len(found), 0.6 * level)
        assert hits >= stats.binom.ppf(1e-4, len(found), 0.2 * level)


def test_one_of_few_simple_families_counts_more_than_one_of_many_others():
    rng = np.random.default_rng(0)
    simple, other = rng.uniform(size=(200, 10)), rng.uniform(size=(200, 3000))
    simple[0, 0] = other[0, 0] = 1e-5
    tests = made(simple, other)
    in_all = InAll.of(tests)
    first, last = (in_all.p_value(next(t for t in tests if t.family is one)) for one in (SIMPLE, OTHER))
    assert first == pytest.approx(4e-4, rel=0.5)
    assert last == pytest.approx(0.11, rel=0.5)


def test_smooth_courses_and_groups_of_a_column_are_simple_and_no_narrower_ones():
    column = np.linspace(0.0, 1.0, 40)
    curves = [by_group("band", np.arange(40) % 3, np.arange(40) % 3), *over_column("load", column, 32)]
    simple = {
        c.label
        for c in (*curves, *stretches(40, "time"))
        if Family("", Pattern("", (0,), c), column).is_simple
    }
    assert simple == {"by band", "along load"}
    assert SIMPLE.is_simple
    assert not OTHER.is_simple
