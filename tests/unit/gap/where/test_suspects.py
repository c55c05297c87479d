"""What a wrong site may vary like: ripples narrowed to the half waves that bring the evidence."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from dtprob.gap.where.along import curves
from dtprob.gap.where.curves import Curves
from dtprob.gap.where.families import Family, Pattern, Summed
from dtprob.gap.where.family_test import FamilyTest, family_test
from dtprob.gap.where.suspects import plainest, suspects

N_ROW = 240
RIPPLE = "ripple in row, 33 to 64 half waves"
SITE = SimpleNamespace(name="mean", rows=None)


@pytest.fixture(scope="module")
def ripples():
    """The band of ripples along 240 rows without columns."""
    problem = SimpleNamespace(declaration=SimpleNamespace(observed={}), data={})
    return next(c for c in curves(problem, "row", N_ROW) if c.label == RIPPLE)


def family_of(found):
    return Family("additive", Pattern(found.label, (0,), found), np.ones(()))


def test_a_ripple_is_narrowed_to_the_half_waves_that_bring_the_evidence(ripples):
    """Of 32 scores of unit variance one is 8: its band alone has more evidence than all together."""
    scores = np.random.default_rng(0).normal(size=(9, 32))
    scores[0, 5] = 8.0
    found = suspects(SITE, [FamilyTest(family_of(ripples), 0.0, np.ones(9), scores, np.ones(32))])
    assert [s.family.pattern.label for s in found] == ["ripple in row, 38 to 38 half waves", RIPPLE]
    np.testing.assert_array_equal(found[0].family.pattern.curves.values, ripples.values[5:6])
    exact = 0.5 * (64 - 1 - np.log(64)) - np.log(32 + 31 + 29 + 25 + 17)
    assert found[0].evidence == pytest.approx(exact, abs=0.1)
    chosen = np.log(32 + 31 + 29 + 25 + 17)
    assert [s.price for s in found] == pytest.approx([chosen, 0.0])


def test_what_was_picked_of_many_families_costs_their_number(ripples):
    one = FamilyTest(family_of(ripples.band(0, 1)), 0.0, np.ones(9), np.full((9, 1), 5.0), np.ones(1))
    (first, *_) = suspects(SITE, [one] * 20)
    assert first.price == pytest.approx(np.log(20))


def test_a_band_of_one_half_wave_is_left_as_it_is(ripples):
    one = family_of(ripples.band(0, 1))
    found = suspects(SITE, [FamilyTest(one, 0.0, np.ones(9), np.full((9, 1), 5.0), np.ones(1))])
    assert [s.family for s in found] == [one]


def test_of_places_that_overlap_the_best_one_alone_may_be_what_varies():
    """One of eight is out by 8; all together would count the same scores many times over."""
    places = Curves("near a place", np.eye(8), overlaps=True, places=tuple(f"place {i}" for i in range(8)))
    scores = np.random.default_rng(1).normal(size=(9, 8))
    scores[0, 5] = 8.0
    (found,) = suspects(SITE, [FamilyTest(family_of(places), 0.0, np.ones(9), scores, np.ones(8))])
    assert found.family.label == "additive, place 5"
    np.testing.assert_array_equal(found.family.pattern.curves.values, np.eye(8)[[5]])
    assert found.evidence == pytest.approx(0.5 * (64 - 1 - np.log(64)) - np.log(8), abs=1e-6)
    assert found.price == pytest.approx(np.log(8))


def test_what_varies_along_a_column_is_not_named_by_one_of_many_places_that_show_it(ripples):
    """Eight places that overlap are all out by 4, one cosine along a column by 10; together the places are the surest."""
    places = Curves("near a place", np.eye(8), overlaps=True, places=tuple(f"place {i}" for i in range(8)))
    scores = np.random.default_rng(1).normal(size=(9, 8))
    scores[0] = 4.0
    near = FamilyTest(family_of(places), 1e-14, np.ones(9), scores, np.ones(8))
    wave = FamilyTest(family_of(ripples.band(0, 1)), 1e-13, np.ones(9), np.full((9, 1), 10.0), np.ones(1))
    assert plainest(near, [near, wave]) is wave
    assert plainest(near, [near, wave._replace(p_value=1e-6)]) is near  # far less sure
    alone = scores.copy()
    alone[0] = [0, 0, 0, 12.0, 0, 0, 0, 0]
    one = near._replace(first=alone)
    assert plainest(one, [one, wave]).pattern == "place 3"
    other = wave._replace(family=dataclasses.replace(wave.family, kind="spread"))
    assert plainest(near, [near, other]) is near


def test_far_out_the_evidence_names_a_family_and_not_the_tail_of_replicates(ripples):
    """Eight places out by 12, a cosine by 25: of 99 replicates no single score has a tail as thin as the places' sum."""
    random = np.random.default_rng(2)
    places = Curves("near a place", np.eye(8), overlaps=True, places=tuple(f"place {i}" for i in range(8)))
    scores, single = random.normal(size=(100, 8)), random.normal(size=(100, 1))
    scores[0], single[0] = 12.0, 25.0
    near, wave = family_test(family_of(places), scores), family_test(family_of(ripples.band(0, 1)), single)
    assert near.p_value < 1e-60 < wave.p_value < 1e-30
    assert plainest(near, [near, wave]) is wave


def test_what_follows_a_column_is_told_by_it_and_not_by_positions():
    """Ten days of 24 slots off by a wave of each day: their hours say so in fewer words than half waves of all slots."""
    size, rng = 240, np.random.default_rng(3)
    hour = np.arange(size) % 24
    given = {"hour": hour, "lane": rng.integers(0, 5, size)}
    problem = SimpleNamespace(
        declaration=SimpleNamespace(observed={"y": SimpleNamespace(axes=("slot",), shape=(size,))}),
        data=given,
        observed=SimpleNamespace(arguments=frozenset()),
    )

    def named(shift):
        entries = rng.normal(size=(100, size))
        entries[0] += shift
        summed = Summed(entries[..., None])
        families = [family_of(c) for c in curves(problem, "slot", size)]
        families.append(Family("additive", Pattern("slot", (0,)), np.ones(())))
        tests = [family_test(family, family.pattern.scores(summed)) for family in families]
        surest = min(tests, key=lambda test: (test.p_value, -np.mean(test.first[0] ** 2 / test.variance)))
        return surest.family.pattern.label, plainest(surest, tests).pattern

    surest, told = named(12.0 * np.cos(2 * np.pi * (hour + 0.5) / 24))  # twenty half waves of all slots
    assert surest.startswith("ripple in slot")
    assert told == "by hour"
    # what neither hours nor lanes follow
    surest, told = named(2.0 * np.sin(2 * np.pi * np.arange(size) / 31))
    assert surest.startswith("ripple in slot")
    assert told == surest


@pytest.mark.parametrize(("score", "is_told"), [(3.0, False), (6.0, True)])
def test_a_column_is_named_only_where_it_is_nearly_as_evident(score, is_told, ripples):
    """One cosine of all rows is out by 10, four lanes by 3 or by 6 each: 47 nats against some 13 or 64."""
    lanes = Curves("by lane", np.eye(4), plain=True)
    wave = FamilyTest(family_of(ripples.band(0, 1)), 1e-14, np.ones(9), np.full((9, 1), 10.0), np.ones(1))
    lane = FamilyTest(family_of(lanes), 1e-13, np.ones(9), np.full((9, 4), score), np.ones(4))
    assert plainest(wave, [wave, lane]) is (lane if is_told else wave)


def test_a_place_is_told_over_a_column_sooner_than_over_what_the_model_computes():
    """Distance and the level that the twin computes of it show the same shadow; only the first was measured."""
    scores = np.random.default_rng(1).normal(size=(50, 8))
    scores[0, 3] = 12.0
    of_model = Curves("between two values of mean", np.eye(8), overlaps=True, places=("mean",) * 8)
    of_data = dataclasses.replace(of_model, places=("distance",) * 8, of_data=True)
    computed, measured = (family_test(family_of(c), scores) for c in (of_model, of_data))
    assert plainest(computed, [computed, measured]).pattern == "distance"
    weak = measured._replace(first=0.5 * measured.first)
    assert plainest(computed, [computed, weak]).pattern == "mean"


def test_a_common_scale_is_the_first_suspect_where_it_makes_all_scores_scatter():
    """Residuals of twice the spread: 64 ripples of their squares have more evidence to first order, and say nothing."""
    rng = np.random.default_rng(4)
    rows = rng.normal(size=(200, 600))
    rows[0] *= 2.0
    each, wave = (rows**2 - 1) / 2**0.5, np.cos(np.pi * np.outer(np.arange(200, 264), np.linspace(0, 1, 600)))
    kinds = {
        "common": (None, each.sum(1, keepdims=True)),
        "ripple": (Curves("ripple", wave), each @ wave.T),
        "each": (None, each),
    }
    tests = [
        family_test(Family("spread", Pattern(label, (0,), found), np.ones(())), scores)
        for label, (found, scores) in kinds.items()
    ]
    found = {s.family.pattern.label: s for s in suspects(SITE, tests)}
    assert found["ripple"].evidence > 30
    assert found["common"].steady > 10
    assert found["ripple"].steady < 1
    assert next(iter(found)) == "common"
