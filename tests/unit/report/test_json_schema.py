"""report.json: what is accepted, and what is refused with which words."""

import json
import math
from typing import Any

import pytest
import xarray as xr

from dtprob.commands import diagnose
from dtprob.errors import InputError
from dtprob.report.json_schema import VERDICTS, to_json, validate


def _report(**changes: Any) -> dict[str, Any]:
    cause = {
        "effects": ["timing_offset"],
        "alias_class": [["timing_offset"], ["carrier_phase_drift"]],
        "probability": 0.97,
        "size": {"delay_s": {"mean": 1e-9, "low": 9e-10, "high": 1.1e-9}},
        "closed_fraction": {"mean": 0.93, "low": 0.88, "high": 0.97},
    }
    return {
        "verdict": "LISTED",
        "causes": [cause],
        "where": {
            "sites": [{"site": "path_delay", "p_value": 1e-9, "share": 0.8}],
            "coordinates": [{"axes": {"rx_antenna": [0, 1]}, "p_value": 1e-6, "share": 0.4}],
        },
        "gap": {
            "unit": "nats per observation",
            "before": 1.23,
            "after": 0.10,
            "floor": [0.02, 0.08],
            "in_user_terms": {"channel_nmse_db": [-3.1, -17.8]},
        },
        "unlisted": {"p_value": 0.4, "sites": []},
        "next_measurement": None,
        "detectable": [{"effect": "iq_imbalance", "size": 0.01}],
        "provenance": {"dtprob": "0.1.0", "seed": 0, "engine": "laplace", "data_sha256": "ab"},
        **changes,
    }


def _cause(**changes: Any) -> dict[str, Any]:
    return {**_report()["causes"][0], **changes}


def test_the_documented_report_is_valid() -> None:
    report = _report()
    assert validate(report) is report
    assert json.loads(to_json(report)) == report


def test_all_verdicts_are_known() -> None:
    assert set(VERDICTS) == {"NO_GAP", "LISTED", "LISTED_WITH_REMAINDER", "UNLISTED", "UNDETERMINED"}
    for verdict in VERDICTS:
        validate(_report(verdict=verdict))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"verdict": "LISTD"}, r"report\.verdict: .* got 'LISTD'\. Did you mean 'LISTED'\?"),
        ({"cause": []}, r"report: .* got 'cause'\. Did you mean 'causes'\?"),
        ({"detectable": None}, r"report\.detectable: expected a list, got NoneType"),
        (
            {"causes": [_cause(probability=1.2)]},
            r"causes\[0\]\.probability: expected a number from 0 to 1, got 1\.2",
        ),
        ({"causes": [_cause(probability=True)]}, r"causes\[0\]\.probability: expected a number, got True"),
        ({"causes": [_cause(probability=math.nan)]}, r"causes\[0\]\.probability: expected a finite number"),
        ({"causes": [_cause(effects="x")]}, r"causes\[0\]\.effects: expected a list, got str"),
        (
            {"causes": [_cause(size={"a": {"mean": 1.0, "low": 2.0, "high": 0.0}})]},
            r"causes\[0\]\.size\.a: expected low <= high",
        ),
        (
            {"causes": [_cause(closed_fraction={"mean": 1.0, "low": 0.5})]},
            r"closed_fraction: expected the key 'high', got the keys mean, low",
        ),
        ({"causes": [_cause(probability=0.1), _cause(probability=0.9)]}, r"report\.causes: expected falling"),
        ({"provenance": {"versions": {"x": math.inf}}}, r"provenance\.versions\.x: expected a finite number"),
        ({"provenance": {"when": object()}}, r"provenance\.when: expected a value that JSON can hold"),
        (
            {"next_measurement": {"cost": [1, math.nan]}},
            r"next_measurement\.cost\[1\]: expected a finite number",
        ),
        (
            {
                "unlisted": {
                    "p_value": None,
                    "sites": ["a"],
                    "located": [{"site": "a", "p_value": 2, "share": 0}],
                }
            },
            r"located\[0\]\.p_value",
        ),
    ],
)
def test_what_is_wrong_is_named(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        validate(_report(**changes))


def test_missing_key_is_named() -> None:
    report = _report()
    del report["unlisted"]
    with pytest.raises(InputError, match=r"report: expected the key 'unlisted'"):
        validate(report)


def test_a_bracket_has_two_ends() -> None:
    report = _report()
    report["gap"]["floor"] = [0.1]
    with pytest.raises(InputError, match=r"report\.gap\.floor: expected 2 numbers, got 1 of them"):
        validate(report)


def test_optional_entries_may_be_there() -> None:
    candidate = {"effect": "a", "sites": ["s"], "z": None, "p_value": None, "adjusted_p_value": None}
    nuisance = {"name": "n", "mean": 1, "low": 0.5, "high": 2.0, "unit": "m", "contraction": 0.3}
    fit = {"nuisances": [nuisance], "converged": True, "n_clusters": 3, "n_observations": 12, "warnings": []}
    cause = _cause(physics="p", strata={"estimate": [1.0, 2.0]}, plausible=True)
    validate(_report(summary="s", screening=[candidate], fit=fit, causes=[cause]))


def test_a_page_that_cannot_be_drawn_does_not_cost_the_answer(tmp_path, monkeypatch):
    def undrawn(*_: object, **__: object) -> str:
        raise ZeroDivisionError

    monkeypatch.setattr(diagnose, "render", undrawn)
    with pytest.raises(ZeroDivisionError):
        diagnose.write_diagnosis(tmp_path, _report(), xr.DataTree(), title="a page")
    assert json.loads((tmp_path / "report.json").read_text()) == _report()
    assert not (tmp_path / "report.html").exists()
