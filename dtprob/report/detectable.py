"""What would have been seen: for each family of effects the sizes from which its instances show."""

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from dtprob.report.advice import family
from dtprob.report.json_schema import Detectable, Meaning
from dtprob.report.names import words
from dtprob.report.sizes import LOG, as_factor, meant, meant_unit
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
    groups: dict[tuple[str, str, str, str], list[Detectable]] = {}
    for entry in entries:
        parameter, unit, meaning = entry.get("parameter", ""), entry.get("unit", "1"), _meaning(entry)
        said = meaning["words"] if meaning is not None else words(parameter)
        told_as = meaning["told_as"] if meaning is not None else "number"
        groups.setdefault((family(entry["effect"]), said, meant_unit(meaning, unit), told_as), []).append(
            entry
        )
    return [_family(*key, group) for key, group in groups.items()]


def _family(name: str, said: str, unit: str, told_as: str, group: Sequence[Detectable]) -> DetectableFamily:
    shown = _factor if told_as == "factor" else functools.partial(quantity, unit=unit, digits=2)
    sizes = [meant(_meaning(entry), _possible(entry)) for entry in group]
    largest = shown(_largest(sizes))
    smallest = shown(min((size for size in sizes if size is not None), default=None))
    largest_told = largest if largest != DASH else _NEVER
    told = largest_told if smallest == largest else f"{smallest} to {largest_told}"
    return DetectableFamily(words(name), said, largest, told, len(sizes))


def _meaning(entry: Detectable) -> Meaning | None:
    """What the effect means by the size, or the name of its parameter, as `factor of ratio` of a `log_ratio`."""
    if "meaning" in entry:
        return entry["meaning"]
    parameter = entry.get("parameter", "")
    by_name = as_factor(parameter, entry.get("unit", "1"))
    return by_name and {**by_name, "words": f"factor of {words(parameter.removeprefix(LOG))}"}


def _possible(entry: Detectable) -> float | None:
    """The size, or None where it is beyond the whole: an angle above half a turn, a part above 1."""
    size, is_part = entry["size"], entry.get("parameter") in {"fraction", "share"}
    limit = math.pi if entry.get("unit") == "rad" else 1.0 if is_part else math.inf
    return size if size is not None and size <= limit else None


def _largest(sizes: Iterable[float | None]) -> float | None:
    """The largest size; None, which has no bound, is larger than any."""
    found = list(sizes)
    known = [size for size in found if size is not None]
    return max(known) if len(known) == len(found) else None


def _factor(value: float | None) -> str:
    """A factor with two digits of what it differs from 1 by."""
    return number(value, None if value is None else decimals_for(abs(value - 1)))
