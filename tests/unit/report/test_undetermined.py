"""A diagnosis is written and shown whatever of its numbers the data do not determine."""

import json
import math
import re
from typing import Any

import pytest

from dtprob.errors import InputError
from dtprob.gap.diagnosis import plain
from dtprob.report import names, render, to_json, validate
from dtprob.report.detectable import detectable_families
from dtprob.report.json_schema import VERDICTS
from dtprob.report.page import bar
from dtprob.report.units import DASH, number, p_value, percent, quantity, reading

NAN, INF = math.nan, math.inf


def _report(verdict: str) -> dict[str, Any]:
    """A report in which every number that may be undetermined is NaN or infinite."""
    size = {"mean": NAN, "low": -INF, "high": INF, "unit": "s"}
    cause = {
        "effects": ["timing_offset"],
        "alias_class": [["timing_offset"]],
        "probability": 0.5,
        "size": {"delay": size},
        "closed_fraction": {"mean": NAN, "low": -INF, "high": INF},
        "strata": {"estimate": [1e-9, NAN]},
    }
    block = {"axes": {"rx_antenna": [0, 1]}, "p_value": NAN, "share": NAN}
    site = {"site": "path_delay", "p_value": NAN, "share": INF}
    candidate = {"effect": "a", "sites": ["s"], "z": NAN, "p_value": NAN, "adjusted_p_value": NAN}
    return {
        "verdict": verdict,
        "causes": [cause, cause],
        "where": {"sites": [site], "coordinates": [block]},
        "gap": {
            "unit": "nats per observation",
            "before": INF,
            "after": NAN,
            "floor": [-INF, 0.1],
            "in_user_terms": {"channel_nmse_db": [-INF, NAN], "throughput": [0.5, NAN]},
        },
        "unlisted": {"p_value": NAN, "sites": ["path_delay"], "located": [site]},
        "next_measurement": None,
        "detectable": [{"effect": "b[x]", "size": INF}, {"effect": "b[y]", "size": 1.0}],
        "screening": [candidate],
        "fit": {"nuisances": [{"name": "n", **size, "contraction": NAN}], "converged": False},
        "provenance": {"seed": 0},
    }


@pytest.mark.parametrize("verdict", VERDICTS)
def test_what_is_not_determined_is_null_in_the_file_and_a_dash_on_the_page(verdict: str) -> None:
    report = plain(_report(verdict))
    assert json.loads(to_json(report)) == report
    text = re.sub(r"<style>.*?</style>|<[^>]*>", " ", render(report, None, title="t"), flags=re.DOTALL)
    assert DASH in text.partition("Skip to the verdict")[2]
    assert not re.search(r"\b(nan|inf|null|None(?! is proposed| of these))\b", text)


@pytest.mark.parametrize("place", ["probability", "verdict", "axes"])
def test_what_is_always_determined_may_not_be_null(place: str) -> None:
    report = _report("LISTED")
    if place == "verdict":
        report["verdict"] = None
    elif place == "axes":
        report["where"]["coordinates"][0]["axes"]["rx_antenna"] = [0, NAN]
    else:
        report["causes"][0]["probability"] = NAN
    with pytest.raises(InputError, match=place if place != "axes" else "rx_antenna"):
        validate(plain(report))


def test_numbers_that_are_not_determined_are_dashes_without_a_unit() -> None:
    assert [number(None), percent(None), p_value(None), quantity(None, "s")] == [DASH] * 4
    assert reading(1e-9, 5e-10, None, "s").mean_with_unit == "1.00\u202fns"
    assert reading(1e-9, 5e-10, None, "s").interval == f"0.500 to {DASH}"
    assert reading(None, None, None, "s").interval == DASH
    assert names.shares({"mean": None, "low": None, "high": 0.9}) == f"{DASH} to 90%"
    assert bar({"mean": 1.0, "low": None, "high": 2.0}) is None


def test_a_family_with_an_instance_that_is_never_seen_has_no_size() -> None:
    (family,) = detectable_families(plain(_report("NO_GAP"))["detectable"])
    assert (family.size, family.count) == (DASH, 2)
