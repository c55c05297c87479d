"""Scores of withheld cases."""

import pytest
from scipy import stats

from dtprob.errors import InputError
from dtprob.gap.score import Rate, score
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


def test_wrong_keys_and_answers():
    with pytest.raises(InputError, match=r"key\.json"):
        score({"cases": [{"name": "a"}]}, {})
    with pytest.raises(InputError, match="none"):
        score(KEY, {"9999": None})
