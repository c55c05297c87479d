"""Numbers as people read them: SI units become ns, cm, MHz, degrees or dBm, with as many digits as help."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

DASH = "–"
"""Stands for a number that is not determined."""

_DECIMALS, _MOST_PLACES = 6, 15
"""The most decimals that are shown, and the most before a power of ten, which is all that a number holds."""
_NARROW = "\u202f"
_MINUS = "\u2212"
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

_PREFIXES: dict[str, tuple[tuple[float, str], ...]] = {
    "s": ((1e-12, "ps"), (1e-9, "ns"), (1e-6, "µs"), (1e-3, "ms"), (1.0, "s")),
    "m": ((1e-3, "mm"), (1e-2, "cm"), (1.0, "m"), (1e3, "km")),
    "Hz": ((1.0, "Hz"), (1e3, "kHz"), (1e6, "MHz"), (1e9, "GHz")),
}
_SUFFIXES = {"s": "s", "m": "m", "hz": "Hz", "rad": "rad", "deg": "deg", "db": "dB", "dbm": "dBm", "w": "W"}
_LABELS = {"deg": "°", "1": ""}
_FACTORS = {
    "rad": (180 / math.pi, "°"),
    "rad/s": (180 / math.pi, "°/s"),
    "rad/s^0.5": (180 / math.pi, "°/√s"),
    "Np": (20 / math.log(10), "dB"),
    "Np/m": (2e4 / math.log(10), "dB/km"),
}


@dataclass(frozen=True)
class Scale:
    """How numbers of one SI unit are shown: times `factor`, or as dBm, followed by `unit`."""

    factor: float
    unit: str
    is_dbm: bool = False

    @overload
    def __call__(self, value: float) -> float: ...
    @overload
    def __call__(self, value: float | None) -> float | None: ...
    def __call__(self, value: float | None) -> float | None:
        """The number to show; None stays None."""
        if value is None:
            return None
        return 10 * math.log10(value * 1e3) if self.is_dbm else value * self.factor


@dataclass(frozen=True)
class Reading:
    """A mean and its interval, ready to print, all with the same unit and number of decimals."""

    mean: str
    low: str
    high: str
    unit: str

    def __str__(self) -> str:
        """The mean with its interval, as in a sentence."""
        return f"{self.mean_with_unit} (90% interval {self.interval})"

    @property
    def mean_with_unit(self) -> str:
        """`mean unit`."""
        return with_unit(self.mean, self.unit)

    @property
    def interval(self) -> str:
        """`low to high unit`."""
        if self.low == self.high == DASH:
            return DASH
        return f"{self.low} to {with_unit(self.high, self.unit)}"


def split_unit(name: str) -> tuple[str, str]:
    """A name such as ``delay_s`` as its stem and its SI unit; "1" where the name ends in none."""
    stem, _, suffix = name.rpartition("_")
    return (stem, _SUFFIXES[suffix]) if stem and suffix in _SUFFIXES else (name, "1")


def scale_for(numbers: Sequence[float | None], unit: str) -> Scale:
    """The scale that suits the largest magnitude among `numbers`, given in the SI unit `unit`."""
    values = [value for value in numbers if value is not None]
    if unit in _FACTORS:
        return Scale(*_FACTORS[unit])
    if unit == "W" and values and min(values) > 0:
        return Scale(1.0, "dBm", is_dbm=True)
    largest = max((abs(value) for value in values), default=0.0)
    prefixes = _PREFIXES.get(unit)
    if prefixes is None:
        return Scale(1.0, _LABELS.get(unit, unit))
    if largest == 0.0:
        return Scale(1.0, unit)
    factor, label = prefixes[0]
    for candidate, name in prefixes:
        if largest >= 0.9995 * candidate:
            factor, label = candidate, name
    return Scale(1 / factor, label)


def number(value: float | None, decimals: int | None = None, digits: int = 3) -> str:
    """A number with a true minus and `decimals`, or else `digits`; a power of ten where that is shorter.

    Decimals below 0 stand for tens, hundreds and so on.
    """
    if value is None:
        return DASH
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        size = math.floor(math.log10(abs(value)))
        places = 1 if decimals is None else min(max(decimals + size, 1), _MOST_PLACES)
        mantissa, exponent = f"{value:.{places}e}".split("e")
        return f"{mantissa}{_NARROW}×{_NARROW}10{str(int(exponent)).translate(_SUPERSCRIPT)}".replace(
            "-", _MINUS
        )
    if decimals is None:
        decimals = max(0, digits - 1 - int(f"{value:.{digits - 1}e}".partition("e")[2]))
    text = f"{value:.{min(max(decimals, 0), _DECIMALS)}f}"
    if re.fullmatch(r"-0\.?0*", text):
        text = text[1:]
    return text.replace("-", _MINUS)


def with_unit(text: str, unit: str) -> str:
    """A number and its unit, which stay on one line."""
    return text if not unit or text == DASH else f"{text}{'' if unit in {'°', '%'} else _NARROW}{unit}"


def quantity(value: float | None, unit: str, digits: int = 3) -> str:
    """One number of the SI unit `unit`, in the unit that people read."""
    scale = scale_for([value], unit)
    return with_unit(number(scale(value), digits=digits), scale.unit)


def reading(mean: float | None, low: float | None, high: float | None, unit: str) -> Reading:
    """A mean and its interval in one human unit, with two digits of the interval's width."""
    scale = scale_for([mean, low, high], unit)
    decimals = decimals_between(scale(low), scale(high))
    texts = [number(scale(value), decimals) for value in (mean, low, high)]
    return Reading(texts[0], texts[1], texts[2], scale.unit)


def decimals_for(width: float) -> int | None:
    """The decimals that show two digits of an interval's width, see `number`; None where the interval is a point."""
    return 1 - math.floor(math.log10(width)) if width > 0 else None


def decimals_between(low: float | None, high: float | None) -> int | None:
    """The decimals for an interval, or for two numbers to compare; None where one is not determined."""
    return None if low is None or high is None else decimals_for(abs(high - low))


def chance(probability: float) -> str:
    """A probability in percent, never certainty."""
    if probability < 0.01:
        return "< 1%"
    return "> 99%" if probability > 0.99 else percent(probability)


def odds(nats: float) -> str:
    """By how many times something is less likely that lies behind by so many nats, to a million."""
    if abs(nats) < 0.5:
        return "as likely"
    more = "" if nats > 0 else " more likely"
    if abs(nats) > math.log(1e6):
        return f"> 10⁶ times{more}"
    times = math.exp(abs(nats))
    rounded = number(times, 1) if times < 2 else f"{round(times, -int(math.log10(times))):,.0f}"
    return f"{rounded} times{more}"


def percent(value: float | None) -> str:
    """A share in percent."""
    if value is None:
        return DASH
    text = f"{100 * value:.0f}%"
    return "0%" if text == "-0%" else text.replace("-", _MINUS)


def p_value(value: float | None) -> str:
    """A p-value with two digits, as a power of ten below 0.0001."""
    if value is None:
        return DASH
    if value == 0:
        return "< 10⁻³⁰⁰"
    return f"{value:.2f}" if value >= 0.1 else number(value, max(2, 1 - math.floor(math.log10(value))))
