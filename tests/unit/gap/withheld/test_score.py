"""Scores of withheld cases."""

import numpy as np
import pytest
from scipy import stats

from dtprob.errors import InputError
from dtprob.gap.withheld.answers import Answer
from dtprob.gap.withheld.rates import Rate, median, ratio, share_within
from dtprob.gap.withheld.score import SAME, score
from dtprob.gap.withheld.truths import PARAMETERS, SITES
from dtprob.physical import custom_cases, draws, labels_cases
from dtprob.physical.multi_access import faults
from dtprob.report.score_page import render_score


def report(verdict, *effects, classes=(), fraction=0.9):
    cause = {
        "effects": list(effects),
        "alias_class": [list(c) for c in classes] or [list(effects)],
        "probability": 0.95,
        "closed_fraction": {"mean": fraction, "low": 0.8, "high": 1.0},
    }
    return {"verdict": verdict, "causes": [cause] if effects else []}


def case(name, kind, *effects, size=100.0):
    return {"name": name, "kind": kind, "lambda": size, "effects": [{"name": e} for e in effects]}


KEY = {
    "cases": [
        case("0000", "null"),
        case("0001", "null"),
        case("0002", "listed", "blockage[arrival_0]"),
        case("0003", "listed", "doppler"),
        case("0004", "pair", "doppler", "shadowing", size=25.0),
        case("0005", "unlisted", "pedestrian"),
        case("0006", "listed", "doppler"),
        case("0007", "listed", "doppler"),
    ]
}
REPORTS = {
    "0000": report("NO_GAP"),
    "0001": report("LISTED", "doppler"),
    "0002": report(
        "LISTED", "blockage[arrival_45]", classes=[("blockage[arrival_45]",), ("blockage[arrival_0]",)]
    ),
    "0003": report("LISTED", "doppler"),
    "0004": report("LISTED_WITH_REMAINDER", "shadowing", "doppler"),
    "0005": report("UNLISTED"),
    "0006": None,
}


@pytest.fixture(scope="module")
def scored():
    return score(KEY, REPORTS)


def rate(scored, kind, name):
    stratum = next(s for s in scored["strata"] if s["kind"] == kind)
    return stratum["rates"][name]["count"], stratum["rates"][name]["of"]


@pytest.mark.parametrize(
    ("named", "track", "right"),
    [
        ("frequency_ripple[6_cycles]", "channel", True),
        (
            "frequency_ripple[6_cycles]",
            "network",
            False,
        ),  # no such family in that track: the key would have told
        ("doppler[floor]", "channel", False),  # the library has `doppler`, too
        ("blockage[arrival_0]", "channel", False),
    ],
)
def test_a_family_counts_where_the_key_tells_no_instance_and_the_library_has_nothing_else(
    named, track, right
):
    true = "doppler" if named.startswith("doppler") else "frequency_ripple"
    answer = Answer(track, case("0000", "listed", true), report("LISTED", named), None)
    assert answer.is_right is right
    assert answer.is_in_class is right
    assert answer.names_wrong() == [not right]
    assert answer.wrong_names() == [(float(not right), 1.0)]


def test_counts_per_stratum(scored):
    assert rate(scored, "null", "alarm") == (1, 2)
    assert rate(scored, "listed", "right effect first") == (1, 3)
    assert rate(scored, "listed", "right family first") == (2, 3)
    assert rate(scored, "listed", "truth in the class") == (2, 3)
    assert rate(scored, "pair", "right effect first") == (1, 1)
    assert rate(scored, "unlisted", "says unlisted") == (1, 1)
    assert scored["missing"] == ["0007"]
    assert next(s for s in scored["strata"] if s["kind"] == "listed")["verdicts"] == {
        "FAILED": 1,
        "LISTED": 2,
    }


@pytest.mark.parametrize(("count", "of"), [(0, 40), (1, 40), (39, 40), (40, 40), (3, 7)])
def test_intervals_are_exact(count, of):
    """Each limit is the probability at which so few, or so many, have a chance of 2.5%."""
    low, high = Rate(count, of).interval
    assert low == 0 if count == 0 else stats.binom.sf(count - 1, of, low) == pytest.approx(0.025)
    assert high == 1 if count == of else stats.binom.cdf(count, of, high) == pytest.approx(0.025)


def test_the_page_tells_every_case(scored):
    page = render_score(scored)
    assert all(f">{name}<" in page for name in REPORTS)
    assert "Without an answer: 0007." in page
    assert "<script" not in page
    assert "http:" not in page
    assert "https:" not in page


def answered(track, true, *, named=(), size=None, sites=(), shares=(), fraction=None, kind="listed"):
    """An answer with sizes, sites and a closed fraction."""
    size = {"c": {"low": size[0], "high": size[1]}} if size else {}
    cause = {"effects": list(named), "alias_class": [list(named)], "size": size, "closed_fraction": fraction}
    said = {
        "verdict": "LISTED" if named else "UNLISTED",
        "causes": [cause] if named else [],
        "unlisted": {"sites": list(sites)},
        "where": {"sites": [{"site": site} for site in shares]},
    }
    return Answer(track, {"kind": kind, "lambda": 100.0, "effects": list(true)}, said, None)


def true(name, size=1.0, information=100.0):
    return {"name": name, "family": name.split("[")[0], "size": size, "lambda": information}


def test_sizes_are_compared_where_truth_and_library_speak_of_the_same():
    jump = [true("handover", 3.0)]  # the key does not tell the sign
    assert answered("custom", jump, named=["handover"], size=(2.5, 3.5)).covered_size() == [True]
    assert answered("custom", jump, named=["handover"], size=(-3.5, -2.5)).covered_size() == [True]
    assert answered("custom", jump, named=["handover"], size=(3.5, 4.5)).covered_size() == [False]
    assert answered("custom", jump, named=["gain_drift"], size=(2.5, 3.5)).covered_size() == []
    assert answered("network", jump, named=["handover"], size=(2.5, 3.5)).covered_size() == []
    wall = [true("wall[river]", 7.6)]  # whose shadow has a soft edge in truth
    assert answered("custom", wall, named=["wall[river]"], size=(7.0, 8.0)).covered_size() == []
    gain = [true("gain_offset", 20 * 0.1 / 2.302585093)]  # decibels in truth, nepers in the library
    assert answered("channel", gain, named=["gain_offset"], size=(0.0999, 0.1001)).covered_size() == [True]


def test_a_right_answer_can_close_what_estimating_its_parameters_does_not_cost():
    """One parameter from three quarters of data with lambda 100: 1 - 4 / 3 / 100."""
    for low, expected in ((0.98, True), (0.99, False)):
        fraction = {"mean": 0.99, "low": low, "high": 1.0}
        said = answered("custom", [true("wall")], named=["wall"], size=(0, 1), fraction=fraction)
        assert said.covered_fraction() == [expected]
    assert answered("custom", [true("wall")], named=["sector"], fraction=fraction).covered_fraction() == []


def test_the_first_site_is_that_of_the_remainder_or_else_of_the_map():
    gusts = [true("gusts")]
    shares = ["expected_power", "deviation"]
    assert answered("custom", gusts, sites=["deviation"], shares=shares).right_site() == [True]
    assert answered("custom", gusts, shares=shares).right_site() == [False]
    assert answered("custom", [true("unheard_of")], shares=shares).right_site() == []


def test_named_effects_are_counted_one_by_one():
    said = answered("custom", [true("wall"), true("sector")], named=["wall", "gain_drift", "second_slope"])
    assert said.wrong_names() == [(2.0, 3.0)]
    assert said.names_wrong() == [True]


def test_every_family_of_every_track_has_its_sites():
    families = {
        "channel": draws.FAMILIES,
        "network": faults.FAMILIES,
        "labels": labels_cases.FAMILIES,
        "custom": custom_cases.FAMILIES,
    }
    assert {track: set(known) for track, known in SITES.items()} == {t: set(f) for t, f in families.items()}
    assert all(set(PARAMETERS[track]) <= set(SITES[track]) for track in SITES)


def test_rivals_stand_beside_each_stratum():
    rivals = {
        "0001": {"lasso": {**report("NO_GAP"), "seconds": 2.0}},
        "0003": {"lasso": {**report("LISTED", "doppler"), "seconds": 4.0}},
    }
    found = score(KEY, REPORTS, rivals, {"0003": 7.0})
    strata = {stratum["kind"]: stratum for stratum in found["strata"]}
    assert strata["null"]["rivals"]["lasso"]["rates"]["alarm"]["of"] == 1
    assert strata["listed"]["rivals"]["lasso"]["rates"]["right effect first"]["rate"] == 1.0
    assert strata["listed"]["rivals"]["lasso"]["seconds"]["median"] == 4.0
    assert strata["listed"]["seconds"]["median"] == 7.0
    assert strata["unlisted"]["rivals"] == {}
    assert ">lasso<" in render_score(found)


def test_targets_are_counted_over_the_strata_that_they_speak_of():
    found = {line["name"]: line for line in score(KEY, REPORTS)["targets"]}
    assert (found["right effect first"]["count"], found["right effect first"]["of"]) == (1, 3)
    assert (found["alarm without a gap"]["count"], found["alarm without a gap"]["of"]) == (1, 2)
    assert "exact set of two" not in found  # the only pair carries too little information
    assert (found["called unlisted and is not"]["count"], found["called unlisted and is not"]["of"]) == (0, 5)
    assert (
        found["closed fraction of .90 or more"]["count"],
        found["closed fraction of .98 or more"]["count"],
    ) == (1, 0)
    assert "Against what is to be reached" in render_score(score(KEY, REPORTS))


def test_rivals_of_some_cases_stand_beside_the_diagnosis_of_the_same_ones():
    found = score(KEY, REPORTS, {"0001": {"lasso": report("NO_GAP")}})
    alarm = next(line for line in found["targets"] if line["name"] == "alarm without a gap")
    assert (alarm["count"], alarm["of"]) == (1, 2)
    assert {name: (said["count"], said["of"]) for name, said in alarm["rivals"].items()} == {
        SAME: (1, 1),
        "lasso": (0, 1),
    }
    assert SAME in render_score(found)
    everywhere = {name: {"lasso": report("NO_GAP")} for name in REPORTS}
    assert set(score(KEY, REPORTS, everywhere)["targets"][0]["rivals"]) == {"lasso"}


def test_what_broke_off_is_no_silence():
    """A diagnosis that fails on a case without a gap has not kept quiet, and where one is it has found nothing."""
    failed = Answer("custom", case("0000", "null"), None, None)
    assert score({"cases": [failed.truth]}, {"0000": None})["targets"] == []
    gusts = Answer("custom", {**case("0001", "unlisted"), "effects": [true("gusts")]}, None, None)
    assert gusts.right_site() == [False]
    assert Answer("x", {**case("0001", "listed", "a"), "cells": {"row": [1]}}, None, None).cell_scores() == [
        0.0
    ]


def test_who_says_that_none_of_them_is_it_has_not_named_the_truth():
    said = {**report("LISTED", "doppler"), "verdict": "UNLISTED"}
    answer = Answer("channel", case("0000", "listed", "doppler"), said, None)
    assert not answer.is_right
    assert not answer.is_in_class


def alike(*names, percent, z=()):
    """The parts of a report that tell which candidates there were and how they look alike."""
    screening = [{"effect": name, "z": size} for name, size in zip(names, z, strict=False)]
    return {"provenance": {"alike": {"effects": list(names), "percent": percent}}, "screening": screening}


def test_a_key_may_tell_lambda_of_the_case_alone():
    said = report("LISTED", "a") | alike("a", "b", percent=[[], [20]])
    key = {"cases": [case("0000", "listed", "a"), case("0001", "pair", "a", "b")]}
    found = score(
        key, {"0000": said, "0001": report("LISTED", "a", "b") | alike("a", "b", percent=[[], [20]])}
    )
    assert found["cases"][0]["best_possible"] > 0.99
    assert "exact set of two, resolvable" in {line["name"] for line in found["targets"]}
    nothing = {"cases": [case("0000", "listed", "a", size=0.0001)]}
    assert score(nothing, {"0000": said})["cases"][0]["best_possible"] < 0.05


def test_what_the_library_has_in_instances_is_found_by_its_family():
    said = alike("doppler", "extra_path[one]", "extra_path[two]", percent=[[], [0], [0, 95]], z=[0, 3.0, 9.0])
    answer = Answer("channel", case("0000", "listed", "extra_path"), report("LISTED", "doppler") | said, None)
    assert answer.limit is not None
    assert answer.limit.first > 0.5
    pair = Answer("channel", case("0001", "pair", "extra_path", "unknown"), said, None)
    assert not pair.is_resolvable


def test_the_spread_of_what_is_observed_is_another_site_than_its_place():
    noisy = [true("label_noise")]

    def said(family):
        sites = [{"site": "y", "family": family}]
        report = {"verdict": "UNLISTED", "causes": [], "unlisted": {"sites": []}, "where": {"sites": sites}}
        return Answer("labels", {"kind": "unlisted", "lambda": 100.0, "effects": noisy}, report, None)

    assert said("spread, smooth in sample").right_site() == [True]
    assert said("ripple in sample").right_site() == [False]


def test_things_of_one_case_are_not_independent():
    """Two sets of three that are all wrong say as much as two cases do, not six."""
    found = share_within([(3.0, 3.0), (3.0, 3.0), (0.0, 3.0), (0.0, 3.0)])
    assert (found["count"], found["of"], found["rate"]) == (6, 12, 0.5)
    assert (found["low"], found["high"]) == Rate(2, 4).interval


@pytest.mark.parametrize("count", [1, 3, 5, 6, 9, 40])
def test_medians_have_intervals_that_hold_or_none(count):
    draws = np.random.default_rng(0).normal(size=(2000, count))
    found = [median(row) for row in draws]
    if count < 6:
        assert all(one["low"] is None for one in found)
    else:
        held = sum(one["low"] <= 0 <= one["high"] for one in found)
        assert stats.binomtest(held, 2000, 0.95, alternative="less").pvalue > 1e-3


def test_few_or_equal_ratios_have_no_interval():
    assert ratio([(1.0, 1.0)] * 13)["low"] is None
    assert ratio([(0.5, 1.0), (0.7, 1.0)])["low"] is None
    found = ratio([(x, 1.0) for x in (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)])
    assert found["low"] < 0.75 < found["high"]


def test_wrong_keys_and_answers():
    with pytest.raises(InputError, match="'Listed'"):
        score({"cases": [case("0000", "Listed", "a")]}, {"0000": report("NO_GAP")})
    other = report("NO_GAP") | {"provenance": {"data_sha256": "ab"}}
    with pytest.raises(InputError, match="one of other data"):
        score({"cases": [case("0000", "null") | {"sha256": {"y.csv": "cd"}}]}, {"0000": other})
    assert score({"cases": [case("0000", "null") | {"sha256": {"y.csv": "ab"}}]}, {"0000": other})["cases"]
    with pytest.raises(InputError, match=r"key\.json"):
        score({"cases": [{"name": "a"}]}, {})
    with pytest.raises(InputError, match="none"):
        score(KEY, {"9999": None})
