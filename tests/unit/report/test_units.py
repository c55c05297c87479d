"""Numbers as people read them."""

import math

import pytest

from dtprob.report.units import (
    chance,
    number,
    odds,
    p_value,
    percent,
    quantity,
    reading,
    scale_for,
    split_unit,
)


@pytest.mark.parametrize(
    ("value", "unit", "shown"),
    [
        (1e-9, "s", "1.00 ns"),
        (2.5e-13, "s", "0.250 ps"),
        (0.0123, "s", "12.3 ms"),
        (-0.31, "m", "−31.0 cm"),
        (2.0, "m", "2.00 m"),
        (0.004, "m", "4.00 mm"),
        (6.0e9, "Hz", "6.00 GHz"),
        (312.5e3, "Hz", "312 kHz"),
        (math.pi, "rad", "180°"),
        (1e-3, "W", "0 dBm"),
        (0.0, "m", "0 m"),
        (0.1, "Np", "0.869 dB"),
        (1e-3, "Np/m", "8.69 dB/km"),
        (3.0, "dB", "3.00 dB"),
        (0.25, "1", "0.250"),
        (5.0, "S/m", "5.00 S/m"),
    ],
)
def test_si_units_become_human(value: float, unit: str, shown: str) -> None:
    assert quantity(value, unit).replace("\u202f", " ") == shown


def test_an_interval_has_one_unit_and_two_digits_of_its_width() -> None:
    size = reading(1.02e-9, 9.1e-10, 1.13e-9, "s")
    assert (size.mean, size.low, size.high, size.unit) == ("1.02", "0.91", "1.13", "ns")
    power = reading(2.1e-12, 2.05e-12, 2.16e-12, "W")
    assert (power.mean, power.unit) == ("−86.78", "dBm")
    assert reading(2.0, 2.0, 2.0, "1").interval == "2.00 to 2.00"


@pytest.mark.parametrize(
    ("ends", "shown"),
    [
        ((1_234_567.0, 1_230_000.0, 1_239_000.0), "1.2346×10⁶, 1.2300×10⁶ to 1.2390×10⁶"),
        ((2.34e-5, 2.33e-5, 2.35e-5), "2.340×10⁻⁵, 2.330×10⁻⁵ to 2.350×10⁻⁵"),
        ((2.3e7, 1e7, 4e7), "2.3×10⁷, 1.0×10⁷ to 4.0×10⁷"),
        ((999_999.0, 999_000.0, 1_000_500.0), "999999, 999000 to 1.0005×10⁶"),
    ],
)
def test_powers_of_ten_show_the_interval_too(ends: tuple[float, float, float], shown: str) -> None:
    """The ends of a narrow interval far from 1 looked the same."""
    size = reading(*ends, "1")
    assert f"{size.mean}, {size.interval}".replace("\u202f", "") == shown


def test_dbm_is_not_used_for_what_may_be_zero() -> None:
    assert scale_for([0.0, 1e-3], "W").unit == "W"


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("delay_s", ("delay", "s")),
        ("channel_nmse_db", ("channel_nmse", "dB")),
        ("offset_hz", ("offset", "Hz")),
        ("share", ("share", "1")),
        ("s", ("s", "1")),
    ],
)
def test_a_name_may_end_in_its_unit(name: str, parts: tuple[str, str]) -> None:
    assert split_unit(name) == parts


def test_numbers() -> None:
    assert number(-0.0001, 2) == "0.00"
    assert number(1.5e-7).replace("\u202f", "") == "1.5×10⁻⁷"
    assert number(-2e8).replace("\u202f", "") == "−2.0×10⁸"
    assert number(123456.0) == "123456"


def test_probabilities_are_never_rounded_to_certainty() -> None:
    assert [chance(p) for p in (0.0, 0.004, 0.5, 0.97, 0.996, 1.0)] == [
        "< 1%",
        "< 1%",
        "50%",
        "97%",
        "> 99%",
        "> 99%",
    ]
    assert [percent(share) for share in (0.0, 0.004, 1.0, -0.1, -0.003)] == [
        "0%",
        "0%",
        "100%",
        "−10%",
        "0%",
    ]


def test_odds_are_told_with_one_digit() -> None:
    told = {0.3: "as likely", 0.6: "1.8 times", 2.2: "9 times", 2.25: "9 times", 3.0: "20 times"}
    told |= {7.2: "1,000 times", -4.0: "50 times more likely", 500.0: "> 10⁶ times"}
    assert {nats: odds(nats) for nats in told} == told


def test_p_values() -> None:
    assert [p_value(p) for p in (0.4, 0.0123, 0.0)] == ["0.40", "0.012", "< 10⁻³⁰⁰"]
    assert p_value(3e-9).replace("\u202f", "") == "3.0×10⁻⁹"
