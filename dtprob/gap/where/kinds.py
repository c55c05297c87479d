"""What labels of site families tell: kinds of what may be wrong with an observation, and where something is wrong.

Light to import: a page is made of a report without the diagnosis.
"""

import re
from typing import Final

_MOMENTS: Final = (
    "spread",
    "shape",
    "skewness",
    "tails",
    "dispersion",
    "circularity",
    "dependence",
    "repeats",
)
"""Their first words."""


def moment(family: str) -> str | None:
    """What of an observation a family of this label moves, if not values: "spread", "dependence along link"."""
    kind = family.partition(",")[0]
    return kind if kind.split(" ")[0] in _MOMENTS else None


def whereabouts(family: str) -> str | None:
    """Where or along what a family of this label is wrong, if it tells: "slot 408 to 435", "along day by gateway"."""
    pattern = family.partition(", ")[2]
    is_law = pattern.startswith(("along ", "over "))
    is_place = re.search(r"\d", pattern) is not None and not pattern.startswith("ripple ")
    return pattern if is_law or is_place else None
