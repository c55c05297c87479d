"""What would have been seen: for each family of effects the sizes from which its instances show."""

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from dtprob.report.advice import family
from dtprob.report.json_schema import Detectable
from dtprob.report.names import LOG, exponential, is_factor, words
from dtprob.report.units import DASH, decimals_for, number, quantity

_NEVER = "not at all"


@dataclass(frozen=True)
class DetectableFamily:
    """What would have been seen of one family: of its most and least visible instances, and how many there are."""

    name: str
    parameter: str
    size: str
    sizes: str
    count: int


def detectable_families(entries: Iterable[Detectable]) -> list[DetectableFamily]:
    """For each family and unit the size from which every instance would have been seen, a dash for none.

    The logarithm of a factor is told as the factor. Sizes that nothing can have, such as turns by more than half a
    circle, are none.
    """
    groups: dict[tuple[str, str, str], list[Detectable]] = {}
    for entry in entries:
        key = (family(entry["effect"]), entry.get("parameter", ""), entry.get("unit", "1"))
        groups.setdefault(key, []).append(entry)
    return [
        _family(*key, [_possible(entry["size"], *key[1:]) for entry in group])
        for key, group in groups.items()
    ]


def _family(name: str, parameter: str, unit: str, sizes: Sequence[float | None]) -> DetectableFamily:
    shown = functools.partial(quantity, unit=unit, digits=2)
    if is_factor(parameter, unit):
        parameter, sizes = f"factor of {parameter.removeprefix(LOG)}", list(map(exponential, sizes))
        shown = _factor
    largest = shown(_largest(sizes))
    smallest = shown(min((size for size in sizes if size is not None), default=None))
    largest_told = largest if largest != DASH else _NEVER
    told = largest_told if smallest == largest else f"{smallest} to {largest_told}"
    return DetectableFamily(words(name), words(parameter), largest, told, len(sizes))


def _possible(size: float | None, parameter: str, unit: str) -> float | None:
    """The size, or None where it is beyond the whole: an angle above half a turn, a part above 1."""
    limit = math.pi if unit == "rad" else 1.0 if parameter in {"fraction", "share"} else math.inf
    return size if size is not None and size <= limit else None


def _largest(sizes: Iterable[float | None]) -> float | None:
    """The largest size; None, which has no bound, is larger than any."""
    found = list(sizes)
    known = [size for size in found if size is not None]
    return max(known) if len(known) == len(found) else None


def _factor(value: float | None) -> str:
    """A factor with two digits of what it differs from 1 by."""
    return number(value, None if value is None else decimals_for(abs(value - 1)))
