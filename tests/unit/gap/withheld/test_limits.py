"""What the best possible diagnosis can tell, against closed forms, and the rows of a score that use it."""

import numpy as np
import pytest
from scipy import stats

from dtprob.gap.withheld.answers import Answer
from dtprob.gap.withheld.limits import correlation_matrix, is_resolvable, limit
from dtprob.gap.withheld.rates import median, over_limit, ratio
from dtprob.gap.withheld.score import score
from dtprob.report.score_page import render_score


@pytest.mark.parametrize(("lambda_", "rho"), [(4.0, 0.0), (10.0, 0.5), (25.0, 0.9), (25.0, -0.9)])
def test_of_two_the_larger_score_is_known_in_closed_form(lambda_, rho):
    """|z_1| > |z_2| where (z_1 - z_2) (z_1 + z_2) > 0, and these two are independent."""
    a, b = np.sqrt(lambda_ * (1 - rho) / 2), np.sqrt(lambda_ * (1 + rho) / 2)
    exact = stats.norm.cdf(a) * stats.norm.cdf(b) + stats.norm.cdf(-a) * stats.norm.cdf(-b)
    found = limit(np.array([[1.0, rho], [rho, 1.0]]), 0, lambda_)
    assert found.first == pytest.approx(exact, abs=5 * np.sqrt(exact * (1 - exact) / 2000))
    assert found.named <= found.first


def test_one_alone_must_pass_the_alarm_only():
    """A two-sided test at 1%; the threshold is itself simulated, hence the width."""
    exact = stats.norm.sf(2.576 - 3) + stats.norm.sf(2.576 + 3)
    found = limit(np.eye(1), 0, 9.0)
    assert (found.first, found.class_size) == (1.0, 1.0)
    assert found.named == pytest.approx(exact, abs=0.08)


def test_twins_share_a_class_and_strangers_do_not():
    twins = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert limit(twins, 0, 400.0).class_size == pytest.approx(2.0)
    assert limit(twins, 2, 400.0).class_size == pytest.approx(1.0)
    assert limit(np.eye(200), 0, 0.0).class_size > 50


@pytest.mark.parametrize(("rho", "needed"), [(0.5, 17), (0.9, 84), (0.979, 402)])
def test_what_can_be_resolved(rho, needed):
    matrix = np.array([[1.0, 0.1, rho], [0.1, 1.0, 0.0], [rho, 0.0, 1.0]])
    assert is_resolvable(matrix, 0, 1.02 * needed)
    assert not is_resolvable(matrix, 0, 0.98 * needed)


def test_what_can_be_resolved_beside_another_true_effect():
    """A candidate that is the sum of two true effects is like each by half, and beside one all of the other."""
    half = np.sqrt(0.5)
    matrix = np.array([[1.0, 0.0, half], [0.0, 1.0, half], [half, half, 1.0]])
    assert is_resolvable(matrix, 0, 1000.0)
    assert not is_resolvable(matrix, 0, 1000.0, beside=[1])
    alike = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, 0.0], [0.0, 0.0, 1.0]])
    needed = 2 * stats.norm.isf(0.02) ** 2 / (1 - 0.6**2)  # what the other leaves, against one unlike both
    assert is_resolvable(alike, 0, 1.02 * needed, beside=[1])
    assert not is_resolvable(alike, 0, 0.98 * needed, beside=[1])


def test_a_matrix_is_read_from_its_rows():
    np.testing.assert_allclose(
        correlation_matrix([[], [50], [-10, 0]]), [[1, 0.5, -0.1], [0.5, 1, 0], [-0.1, 0, 1]]
    )


def test_summaries():
    values = np.random.default_rng(0).permutation(101.0 + np.arange(99))
    found = median(list(values))
    assert (found["value"], found["of"]) == (150.0, 99)
    below = int(found["low"] - 100)  # as many values lie at or below it
    assert stats.binom.cdf(below - 1, 99, 0.5) <= 0.025 <= stats.binom.cdf(below + 1, 99, 0.5)
    assert found["high"] - 150 == 150 - found["low"]
    assert ratio([(1.0, 2.0)] * 5)["value"] == 0.5
    mixed = ratio([(0.0, 1.0), (1.0, 1.0)] * 50)
    assert mixed["low"] == pytest.approx(0.4, abs=0.03)
    assert mixed["high"] == pytest.approx(0.6, abs=0.03)
    found = over_limit([(1.0, 0.8)] * 8 + [(0.0, 0.8)] * 2)
    assert found["value"] == pytest.approx(1.0)
    assert found["low"] < 1.0 < found["high"]


def report(
    verdict="NO_GAP", *effects, blocks=(), percent=((), (0,)), z=(5.0, 1.0), classes=(), remainder=None
):
    cause = {
        "effects": list(effects),
        "alias_class": [list(c) for c in classes] or [list(effects)],
        "probability": 0.95,
        "closed_fraction": {"mean": 0.99, "low": 0.9, "high": 1.0},
    }
    names = ["a", "b"]
    return {
        "verdict": verdict,
        "causes": [cause] if effects else [],
        "where": {"sites": [], "coordinates": [{"axes": dict([block])} for block in blocks]},
        "unlisted": {"sites": []},
        "screening": [{"effect": name, "z": value} for name, value in zip(names, z, strict=True)],
        "remainder": remainder,
        "provenance": {"alike": {"effects": names, "percent": [list(row) for row in percent]}},
    }


def case(name, kind, *effects, size=100.0, cells=None):
    listed = [{"name": effect, "lambda": size} for effect in effects]
    return {"name": name, "kind": kind, "lambda": size, "effects": listed, "cells": cells or {}}


def line(found, name):
    return next(line for line in found["targets"] if line["name"].startswith(name))


def test_the_rows_of_a_score():
    key = {
        "cases": [
            case("0", "listed", "a", size=25.0),
            case("1", "listed", "a", size=25.0),
            case("2", "listed", "a", cells={"subcarrier": [2, 3, 4, 5]}),
            case("3", "unlisted", "c"),
            case("4", "unlisted", "c"),
            case("5", "pair", "a", "b"),
            case("6", "null", size=0.0),
        ]
    }
    reports = {
        "0": report("LISTED", "a"),
        "1": report("LISTED", "b", z=(1.0, 5.0)),
        "2": report("LISTED", "a", blocks=[("subcarrier", [4, 5])], classes=[("a",), ("b",)]),
        "3": report("UNLISTED", remainder={"closed_fraction": {"mean": 0.8}}),
        "4": report("LISTED", "a", z=(9.0, 1.0)),
        "5": report("LISTED", "a", "b", percent=((), (99,))),
        "6": report(),
    }
    found = score(key, reports, seconds=dict.fromkeys(reports, 3.0))
    first = line(found, "right effect first over the best possible, lambda 25")
    assert first["of"] == 2
    assert first["value"] == pytest.approx(0.5 / first["limit"])
    assert 0.98 < first["limit"] < 1.0  # five deviations against the 1% level of two candidates
    assert line(found, "right effect first by its score")["of"] == 2
    assert line(found, "size of the class")["value"] == pytest.approx(2.0, rel=0.01)
    assert line(found, "F1")["value"] == pytest.approx(2 * 2 / (2 + 4))
    imitated = line(found, "unlisted called so, not imitated")
    assert (imitated["count"], imitated["of"]) == (1, 1)  # of the other one 80 of 100 are explained
    assert line(found, "unlisted called so")["of"] == 2
    assert line(found, "exact set of two")["of"] == 1
    assert not any(row["name"] == "exact set of two, resolvable" for row in found["targets"])
    assert line(found, "closed by the model of the remainder")["value"] == 0.8
    assert line(found, "seconds")["of"] == 7
    page = render_score(found)
    assert "F1 of the cells touched" in page
    assert "\N{GREATER-THAN OR EQUAL TO}&nbsp;0.97" in page


def test_no_answer_changes_what_is_imitated():
    """Else a wrong answer that is sure of itself would leave its own denominator."""
    shared = report("UNLISTED", z=(3.0, 1.0))
    for said in (
        shared,
        {**shared, **report("LISTED", "a", z=(3.0, 1.0)), "gap": {"before": 0.3, "after": 0.1}},
    ):
        answer = Answer("labels", case("0", "unlisted", "c"), {**said, "fit": {"n_observations": 100}}, None)
        assert answer.unexplained == pytest.approx(100 - 8)


def test_an_answer_without_a_report_reaches_nothing():
    lost = Answer("labels", case("0", "listed", "a", cells={"sample": [1]}), None, None)
    assert lost.limit is None
    assert not lost.is_resolvable
    assert lost.width() == lost.remainder_closed() == []
    assert lost.cell_scores() == [0.0]
