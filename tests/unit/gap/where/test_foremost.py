"""Which entry of a family of a wrong site is named: the one that brings most of what is wrong, if one does."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.gap.diagnose import diagnose
from dtprob.gap.settings import Settings
from dtprob.gap.where.curves import Curves, grouped, groups_in_words
from dtprob.gap.where.families import Family, Pattern
from dtprob.gap.where.family_test import FamilyTest
from dtprob.gap.where.foremost import foremost, names_of_entries
from dtprob.inference import Laplace
from dtprob.testing.room import room_paths
from tests.unit.gap.examples import of_access_points

READINGS = 120


def told(scores, kept=(0,), found=None, shape=None, dtype=float):
    """What is said of scores of unit variance."""
    scores = np.asarray(scores, float)
    site = SimpleNamespace(axes=("link", "antenna"), value=np.ones(shape or (len(scores), 1), dtype))
    family = Family("additive", Pattern("so", kept, found), np.ones(()))
    test = FamilyTest(family, 1e-9, np.ones(9), np.stack([scores] * 9), np.ones(len(scores)))
    return foremost(test, [test], site)


def test_the_entry_that_brings_most_is_named():
    scores = np.random.default_rng(0).normal(size=60)
    scores[17] = 9.0
    assert told(scores) == "link 17"
    assert told(scores, (0, 1), shape=(20, 3)) == "link 5, antenna 2"
    assert told(scores, (0,), shape=(30, 1), dtype=complex) == "link 8"


def test_objects_of_a_scene_are_called_by_their_names():
    scene = replace(room_paths(2, 1), object_names=("floor", "wall_a", "wall_b"))
    names = names_of_entries({"level": np.zeros(3), "paths": scene})
    scores = np.array([0.3, -0.5, 9.0])
    family = Family("additive", Pattern("object", (0,)), np.ones(()))
    test = FamilyTest(family, 1e-9, np.ones(9), np.stack([scores] * 9), np.ones(3))
    site = SimpleNamespace(axes=("object",), value=np.ones(3))
    assert foremost(test, [test], site, names) == "object wall_b"
    assert foremost(test, [test], site, {"object": ("floor", "wall")}) == "object 2"
    assert names_of_entries({"level": np.zeros(3)}) == {}


def test_none_is_named_where_several_are_wrong_or_all_may_be_chance():
    scores = np.random.default_rng(0).normal(size=60)
    assert told(scores) is None
    scores[[3, 17]] = 9.0
    assert told(scores) is None
    assert told([6.0, -6.0]) is None  # of two groups one is as far off as the other
    assert told([9.0]) is None


def test_groups_are_named_by_their_values():
    band, day = np.repeat([2, 5, 7], 40), np.tile([0.5, 1.5], 60)
    index = np.unique(band, return_inverse=True)[1]
    groups = Curves("by band", grouped(index), places=groups_in_words(index, {"band": band}))
    assert told([1.0, 9.0, -1.0], found=groups, shape=(120, 1)) == "band 5"
    each = [1.0, 0.5, -1.0, 9.0, 0.0, 1.0]
    assert told(each, (0, 1), groups, (120, 2)) == "band 5, antenna 1"
    both = np.unique(2 * index + (day > 1), return_inverse=True)[1]
    assert groups_in_words(both, {"band": band, "day": day})[3] == "band 5 and day 1.5"
    overlapping = Curves("beyond", np.eye(3), overlaps=True, places=("a", "b", "c"))
    assert told([1.0, 9.0, -1.0], found=overlapping, shape=(3, 1)) is None  # its label says where


@pytest.mark.study
@pytest.mark.parametrize(("which", "place"), [("group", "access_point 11"), ("reading", "reading 41")])
def test_a_report_says_which_group_or_reading_it_is(which, place):
    rng = np.random.default_rng(2)
    x, access_point = (
        rng.uniform(-1, 1, READINGS),
        rng.permutation(np.repeat(np.arange(10, 18), READINGS // 8)),
    )
    wrong = 2.0 * (access_point == 11) if which == "group" else 12.0 * (np.arange(READINGS) == 41)
    y = 1 + 2 * x + rng.normal(size=READINGS) + wrong
    data = {"x": jnp.asarray(x), "access_point": jnp.asarray(access_point), "y": jnp.asarray(y)}
    found = diagnose(
        of_access_points,
        data,
        [],
        key=jax.random.key(0),
        engine=Laplace(),
        settings=Settings(site_replicates=99),
    )
    assert found.verdict == "UNLISTED"
    assert {one.get("place") for one in found.to_report()["unlisted"]["located"]} == {place}
    assert found.summary.endswith(f"; most of it at {place}.")


def test_a_far_reading_is_no_place_where_single_ones_are_not_wrong_or_something_else_is_more_so():
    """Of readings of a heavy tail one is far; where a block of them is off it brings little of what is wrong."""
    site = SimpleNamespace(axes=("link", "antenna"), value=np.ones((60, 1)))
    alone = np.random.default_rng(0).normal(size=60)
    alone[17] = 9.0
    blocks = Curves("by block", np.eye(4), places=("a", "b", "c", "d"))

    def tested(scores, found, p_value):
        family = Family("additive", Pattern("so", (0,), found), np.ones(()))
        return FamilyTest(family, p_value, np.ones(9), np.stack([scores] * 9), np.ones(len(scores)))

    even, far = np.array([5.0, 5.0, 0.0, 1.0]), np.array([9.0, -9.0, 0.0, 1.0])
    assert foremost(tested(even, blocks, 1e-9), [tested(alone, None, 1e-9)], site) == "link 17"
    assert foremost(tested(even, blocks, 1e-9), [tested(alone, None, 0.2)], site) is None
    assert foremost(tested(far, blocks, 1e-9), [tested(alone, None, 1e-9)], site) is None
    beyond = Curves("beyond", np.tri(40), overlaps=True, places=tuple(map(str, range(40))))
    assert foremost(tested(np.full(40, 7.0), beyond, 1e-9), [tested(alone, None, 1e-9)], site) == "link 17"
    assert foremost(tested(np.full(40, 14.0), beyond, 1e-9), [tested(alone, None, 1e-9)], site) is None
