"""Sizes of effects as people say them: in human units, as factors and shares."""

import math
from collections.abc import Mapping, Sequence
from typing import Final

from dtprob.report.json_schema import Meaning, Size
from dtprob.report.names import listing, words
from dtprob.report.units import Reading, decimals_between, number, reading, scale_for, split_unit, with_unit

LOG: Final = "log_"
_LARGEST: Final = 700.0
"""Largest exponent whose exponential is a number."""


def key_of(effect: str, parameter: str, size: Mapping[str, Size]) -> str | None:
    """The key of an effect's parameter among the sizes of its cause, None where it has none such.

    Args:
        effect: its name, which keys begin with where a cause is several effects.
        parameter: with its unit, as in report.json.
        size: of the cause.
    """
    return next((key for key in (f"{effect}.{parameter}", parameter) if key in size), None)


def size_reading(name: str, size: Size) -> tuple[str, Reading]:
    """The words for a parameter and its size in human units, or as what its effect means by it."""
    owner, _, parameter = _stem(name, size).rpartition(".")
    unit, meaning = _unit(name, size), _meaning(name, size)
    if unit.startswith("Np"):  # shown in dB, which says that it is a logarithm
        parameter = parameter.removeprefix(LOG)
    said = words(parameter)
    if meaning is not None:
        said, unit = meaning["words"] or words(parameter.removeprefix(LOG)), meant_unit(meaning, unit)
    mean, low, high = (meant(meaning, size[end]) for end in ("mean", "low", "high"))
    return said if not owner else f"{words(owner)}: {said}", reading(mean, low, high, unit)


def apart(name: str, size: Size, estimates: Sequence[float | None]) -> str:
    """Estimates of one parameter from several parts of the data, in the unit of its size."""
    meaning = _meaning(name, size)
    ends, values = (
        [meant(meaning, value) for value in row] for row in ((size["low"], size["high"]), estimates)
    )
    scale = scale_for([*ends, *values], meant_unit(meaning, _unit(name, size)))
    decimals = decimals_between(scale(ends[0]), scale(ends[1]))
    return with_unit(listing(number(scale(value), decimals) for value in values), scale.unit)


def meant(meaning: Meaning | None, value: float | None) -> float | None:
    """The number that a size is told as; None stays None."""
    if value is None or meaning is None:
        return value
    match meaning["told_as"]:
        case "percent":
            return 100 * value
        case "factor":
            return math.exp(min(value, _LARGEST))
        case "share":
            return -100 * math.expm1(-value)
        case _:
            return value


def meant_unit(meaning: Meaning | None, unit: str) -> str:
    """The unit of that number, of a size in `unit`."""
    match meaning and meaning["told_as"]:
        case "percent" | "share":
            return "%"
        case "factor":
            return "1"
        case _:
            return unit


def as_factor(parameter: str, unit: str) -> Meaning | None:
    """What the logarithm of a factor, which people read more easily, means by its name alone."""
    return {"words": "", "told_as": "factor"} if parameter.startswith(LOG) and unit == "1" else None


def _meaning(name: str, size: Size) -> Meaning | None:
    """What the effect means by a size, or its name."""
    return size.get("meaning") or as_factor(_stem(name, size).rpartition(".")[2], _unit(name, size))


def _stem(name: str, size: Size) -> str:
    """The key of a size without the unit at its end: `delay_s`, `velocity_m_per_s`."""
    if "unit" not in size:
        return split_unit(name)[0]
    if size["unit"] == "1":  # a number at the end is an entry's
        return name
    unit = size["unit"].replace("/", "_per_").replace("^", "").replace(" ", "_")
    return name[: -len(unit) - 1] if name.lower().endswith(f"_{unit.lower()}") else name


def _unit(name: str, size: Size) -> str:
    return size.get("unit", split_unit(name)[1])
