"""All families of faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from dtprob.errors import unknown_name
from dtprob.physical.multi_access import reception_faults, traffic_faults
from dtprob.physical.multi_access.fault import Fault
from dtprob.physical.multi_access.network import Network

FAMILIES: Final[dict[str, Callable[[np.random.Generator, Network], Fault]]] = {
    **traffic_faults.FAMILIES,
    **reception_faults.FAMILIES,
}
"""For each family, how one is drawn."""
FOREIGN: Final = ("periodic_traffic", "pair_interference")
"""Families that no library of effects has."""
LISTED: Final = tuple(name for name in FAMILIES if name not in FOREIGN)


def draw(rng: np.random.Generator, family: str, network: Network) -> Fault:
    """A fault of a family, at a random device or pair.

    Args:
        rng: source of randomness.
        family: a name in `FAMILIES`.
        network: two clusters or more.

    Raises:
        InputError: no such family.
    """
    if family not in FAMILIES:
        raise unknown_name("family of faults", family, FAMILIES, "family")
    return FAMILIES[family](rng, network)
