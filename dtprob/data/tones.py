"""Frequencies of subcarriers, which count in Hz from the carrier."""

from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.errors import InputError

_NARROWEST: Final = 1e3
"""A span below this, in Hz, is one of numbers in GHz or MHz, or of indices, by mistake."""


def check_tones(frequency: Float[np.ndarray, " subcarrier"], carrier: float | None = None) -> None:
    """Refuse subcarriers that are not in Hz from the carrier.

    Args:
        frequency: of each, Hz.
        carrier: in Hz, where it is known.

    Raises:
        InputError: several at one frequency or within 1 kHz, frequencies that count from zero, or below 0 Hz.
    """
    if len(frequency) > 1 and np.ptp(frequency) < _NARROWEST:
        got = f"{len(frequency)} within {np.ptp(frequency):g} Hz of {frequency[0]:g} Hz"
        remedy = "Give each subcarrier's own frequency in Hz (not MHz or its number), from the carrier"
        raise InputError("subcarrier_frequency", "different frequencies", got, remedy)
    if carrier is not None and len(frequency) and frequency.min() > carrier / 2:
        expected, got = f"Hz from the carrier, {carrier:g} Hz", f"{frequency.min():g} Hz and more"
        raise InputError("subcarrier_frequency", expected, got, "Subtract the carrier")
    if carrier is not None and len(frequency) and frequency.min() <= -carrier:
        got, remedy = (
            f"{frequency.min():g} Hz",
            "Give each subcarrier's own frequency in Hz, from the carrier",
        )
        raise InputError("subcarrier_frequency", f"above -{carrier:g} Hz, minus the carrier", got, remedy)
