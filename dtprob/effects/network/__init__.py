"""What can be wrong with the twin of a network: its traffic, and its shared channel."""

from typing import Final

from dtprob.effects.common import Family
from dtprob.effects.network import arrivals, bad_times, reception, unheard

FAMILIES: Final[dict[str, Family]] = {
    **arrivals.FAMILIES,
    **reception.FAMILIES,
    **bad_times.FAMILIES,
    **unheard.FAMILIES,
}
