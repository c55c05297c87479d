"""The test of a family of scores: dense and sparse departures, and the level where there is none."""

import re

import numpy as np
import pytest
from scipy import stats

from dtprob.gap.where.curves import by_group, cycles, over_column, stretches
from dtprob.gap.where.families import Family, Pattern
from dtprob.gap.where.family_test import family_test

FAMILY = Family("additive", Pattern("link", (0,)), np.ones(()))


def p_of(shift, seed, entries=300, replicates=99):
    rng = np.random.default_rng(seed)
    scores = rng.standard_normal((1 + replicates, entries)) * np.geomspace(0.1, 10, entries)
    scores[0] += shift * np.geomspace(0.1, 10, entries)
    return family_test(FAMILY, scores)


def test_one_entry_of_many_is_noticed():
    one = np.zeros(300)
    one[123] = 7.0
    assert max(p_of(one, seed).p_value for seed in range(10)) < 1e-3


def test_a_little_everywhere_is_noticed():
    assert max(p_of(np.full(300, 1.0), seed).p_value for seed in range(10)) < 1e-3


@pytest.mark.parametrize("entries", [4, 40, 400])
def test_p_values_where_nothing_is_wrong(entries):
    """Not below a level more often than twice it (two statistics), one time in a thousand; replicates likewise."""
    found = [p_of(0.0, seed, entries) for seed in range(300)]
    for level in (0.01, 0.05):
        assert sum(t.p_value <= level for t in found) <= stats.binom.isf(1e-3, 300, 2 * level)
    null = np.concatenate([t.null for t in found])
    assert (null <= 0.01).mean() <= 0.025


@pytest.mark.parametrize("entries", [4, 40])
def test_replicates_are_as_often_far_out_as_data_where_nothing_is_wrong(entries):
    """Among thousands of families it is the far tail that is compared; one time in a thousand each."""
    found = [p_of(0.0, seed, entries) for seed in range(3000)]
    often = np.mean([test.null <= 2e-3 for test in found])
    assert sum(test.p_value <= 2e-3 for test in found) <= stats.binom.isf(1e-3, 3000, often)


def test_stretches_are_sums_over_windows():
    (found,) = stretches(20, "hour")
    values = np.arange(20.0)
    windows = [(low, low + n) for n in (2, 4, 8) for low in range(0, 21 - n, n // 2)]
    np.testing.assert_allclose(found.values @ values, [values[a:b].sum() for a, b in windows])
    assert stretches(4, "hour") == ()


def test_rare_outcomes_are_judged_by_their_sum():
    """Hundreds of entries that move in a few replicates of a hundred: p-values are neither near 1 nor near 0."""
    values = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        chance = rng.choice([0.02, 0.1], 400)
        scores = (rng.random((100, 400)) < chance) * 1.0 - chance
        found = family_test(FAMILY, scores)
        values.append(found.p_value)
        assert found.null.min() > 1e-5
    assert 0.2 < np.median(values) < 0.8
    assert (np.array(values) < 0.02).sum() <= stats.binom.isf(1e-3, 60, 0.04)


def test_a_few_entries_of_heavy_tails_do_not_hide_the_one_that_is_wrong():
    found = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        scores = rng.standard_normal((100, 300))
        scores[:, :20] = rng.standard_t(2, (100, 20))
        scores[0, :20], scores[0, 123] = 0.0, 6.5
        found.append(family_test(FAMILY, scores).p_value)
    assert np.median(found) < 1e-3


def outcomes(rng, chance, draws):
    """Scores (draw, entry) of outcomes of these chances, each seen three times."""
    return rng.binomial(3, chance, (draws, len(chance))) - 3 * chance


def test_outcomes_that_no_replicate_has_are_not_told():
    """One of 40 entries has a chance of .2%, and the data have it."""
    chance = np.full(40, 0.3)
    chance[7] = 0.002
    without, within = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        scores = outcomes(rng, chance, 100)
        scores[1:, 7] = -3 * chance[7] + 1e-4 * rng.normal(size=99)  # what fitted parameters add
        scores[0, 7] = 1 - 3 * chance[7]
        normal = rng.normal(size=(99, 40)) * np.sqrt(3 * chance * (1 - chance))
        without.append(family_test(FAMILY, scores).p_value)
        within.append(family_test(FAMILY, scores, normal).p_value)
    assert max(without) < 1e-12
    assert (np.array(within) < 0.02).sum() <= stats.binom.isf(1e-3, 30, 0.04)


def test_one_rare_outcome_is_no_gap_and_many_are():
    """Chances of .5%, which a replicate or two may have; three of a hundred data sets of the 20 entries have one."""
    chance = np.concatenate([np.full(2, 0.005), np.full(18, 0.3)])
    rare, common = [], []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        scores = outcomes(rng, chance, 100)
        normal = rng.normal(size=(99, 20)) * np.sqrt(3 * chance * (1 - chance))
        scores[0, 0] = 1 - 3 * chance[0]
        rare.append(family_test(FAMILY, scores, normal).p_value)
        scores[0, 5] = 3 - 3 * chance[5]
        scores[0, 6:10] += 1.8
        common.append(family_test(FAMILY, scores, normal).p_value)
    assert min(rare) > 1e-4
    assert np.median(common) < 1e-3


@pytest.mark.parametrize("entries", [300, 1500])
def test_rows_of_heavy_tails_that_are_right_are_no_gap(entries):
    """What is steady was chosen by the replicates that it then judged: one in five such nulls had p below .0001."""
    sums, seeds = stretches(entries, "row")[0].values, 40
    rows = (np.random.default_rng(seed).laplace(size=(100, entries)) for seed in range(seeds))
    p = np.array([family_test(FAMILY, np.asarray((sums @ row.T).T)).p_value for row in rows])
    assert (p < 1e-4).sum() == 0
    assert (p < 0.01).sum() <= stats.binom.ppf(0.999, seeds, 0.03)


def test_names_of_columns_do_not_say_where_something_is_wrong():
    """A digit or the word `ripple` in the name of a column is no place and no ripple; places and laws say where."""
    column = np.random.default_rng(4).permutation(np.arange(40.0))
    found = {c.label: c for c in over_column("ripple_2", column, 16)}
    found |= {
        c.label: c for c in (by_group("sensor_2", np.arange(40) % 4, np.arange(40) % 4), *cycles(120, "slot"))
    }
    scores = np.random.default_rng(5).normal(size=(100, 40))
    scores[0] += 3.0 * (column > 20)

    def tested(label):
        curves = found[label]
        size = curves.extent[1]
        values = np.resize(scores, (100, size))
        family = Family("additive", Pattern(label, (0,), curves), np.ones(()))
        return family_test(family, values @ curves.values.T)

    assert tested("by sensor_2").whereabouts is None
    assert tested("along ripple_2").whereabouts == "along ripple_2"
    assert tested("every 3 along slot").whereabouts == "every 3 along slot"
    assert re.fullmatch(r"beyond [\d.]+ of ripple_2", tested("beyond a value of ripple_2").whereabouts or "")
    assert [label for label, curves in found.items() if curves.ripple is not None] == [
        "ripple in ripple_2, 5 to 8 half waves",
        "ripple in ripple_2, 9 to 16 half waves",
    ]
    assert tested("ripple in ripple_2, 5 to 8 half waves").whereabouts is None
