"""Kinds of what may be wrong with an observation where its values are right, as families of sites are labelled.

Light to import: a page is made of a report without the diagnosis.
"""

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
