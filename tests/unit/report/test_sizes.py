"""Sizes told as what their effects mean by them."""

import pytest

from dtprob.report.detectable import detectable_families
from dtprob.report.json_schema import Detectable, Meaning, Size
from dtprob.report.sizes import apart, size_reading

SLEEP: Size = {
    "mean": 0.478,
    "low": 0.315,
    "high": 0.647,
    "unit": "1",
    "meaning": {"words": "slots in which its radio is off", "told_as": "share"},
}


def test_a_share_is_told_as_one() -> None:
    label, shown = size_reading("sleep", SLEEP)
    assert label == "slots in which its radio is off"
    assert str(shown) == "38% (90% interval 27 to 48%)"
    assert apart("sleep", SLEEP, [0.4, 0.5]) == "33 and 39%"
    assert size_reading("duty_cycle[device_1].sleep", SLEEP)[0] == f"duty cycle (device 1): {label}"


@pytest.mark.parametrize(
    ("meaning", "said"),
    [
        ({"words": "odds", "told_as": "factor"}, "1.62"),
        ({"words": "part of the log", "told_as": "percent"}, "48%"),
        ({"words": "spread", "told_as": "number"}, "0.48"),
    ],
)
def test_other_numbers_are_told_as_they_are_meant(meaning: Meaning, said: str) -> None:
    size: Size = {"mean": 0.48, "low": 0.4, "high": 0.57, "unit": "1", "meaning": meaning}
    label, shown = size_reading("amount", size)
    assert (label, shown.mean_with_unit) == (meaning["words"], said)


def test_sizes_that_would_have_been_seen_are_told_alike() -> None:
    entries: list[Detectable] = [
        {
            "effect": f"duty_cycle[{k}]",
            "size": size,
            "parameter": "sleep",
            "unit": "1",
            "meaning": SLEEP["meaning"],
        }
        for k, size in enumerate((0.3, 0.6))
    ]
    (family,) = detectable_families(entries)
    assert (family.parameter, family.sizes, family.size) == (SLEEP["meaning"]["words"], "26% to 45%", "45%")
