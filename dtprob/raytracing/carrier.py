"""The carrier of a scene, at which its materials are fixed."""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from dtprob.errors import InputError

_CARRIER: Final = "dtprob_carrier"
"""Attribute of a scene: the carrier at which its materials were fixed, in Hz, as the scene holds it."""
_LEAST: Final = 1e6
"""Carriers below this, in Hz, are numbers in GHz or MHz by mistake."""
_LAW: Final = "dtprob_law"
"""Attribute of a material: its `_Law`, taken from it so that it keeps its values."""


class _Law(NamedTuple):
    """How a material depends on the carrier, and the permittivity and conductivity that it was given."""

    callback: Callable[[Any], Any]
    values: tuple[float, float]


def check_carrier(where: str, frequency: float) -> None:
    """Refuse a carrier that cannot be in Hz.

    Args:
        where: it was given, in words.
        frequency: the number.

    Raises:
        InputError: it is below 1 MHz, or no number.
    """
    if not frequency >= _LEAST:
        raise InputError(where, "a frequency in Hz, such as 3.5e9", f"{frequency:g}", "Give it in Hz")


def set_frequency(scene: Any, frequency: float) -> Any:
    """Set the carrier of a scene, then fix its materials at their values there.

    Materials whose values were edited since they were fixed keep those.

    Args:
        scene: a ``sionna.rt.Scene``, changed in place and given back.
        frequency: carrier in Hz.

    Raises:
        InputError: the frequency is not positive, or a material is not known there.
    """
    if not frequency > 0:
        raise InputError(
            "frequency of the scene", "a positive carrier in Hz", repr(frequency), "Give it in Hz"
        )
    materials = [one for one in scene.radio_materials.values() if hasattr(one, "frequency_update_callback")]
    laws = [_law(material) for material in materials]
    for material in materials:
        material.frequency_update_callback = None
    try:
        scene.frequency = frequency
        for material, law in zip(materials, laws, strict=True):
            material.frequency_update_callback = law
    except ValueError as error:
        raise unknown_materials(frequency, error) from error
    for material, law in zip(materials, laws, strict=True):
        if law is not None:
            setattr(material, _LAW, _Law(law, _values(material)))
        material.frequency_update_callback = None
    setattr(scene, _CARRIER, _held(scene))
    return scene


def carrier_of(scene: Any) -> float:
    """The carrier of a scene in Hz, in single precision.

    Raises:
        InputError: it is not the one at which the materials were fixed.
    """
    held = _held(scene)
    fixed = getattr(scene, _CARRIER, held)
    if held != fixed:
        expected = f"{fixed:.6g} Hz, at which its materials were fixed"
        remedy = "Change it with dtprob.raytracing.carrier.set_frequency"
        raise InputError("frequency of the scene", expected, f"{held:.6g} Hz", remedy)
    return held


def unknown_materials(frequency: float, error: ValueError) -> InputError:
    """What to raise for the solver's refusal of a material at a carrier in Hz."""
    expected = f"materials that are known at {frequency / 1e9:g} GHz"
    return InputError("scene", expected, f"'{error}'", "Choose another carrier or other materials")


def _law(material: Any) -> Callable[[Any], Any] | None:
    """How a material depends on the carrier; None where it does not, or was edited since it was fixed."""
    own = material.frequency_update_callback
    kept: _Law | None = getattr(material, _LAW, None)
    if own is not None or kept is None:
        return own
    return kept.callback if _values(material) == kept.values else None


def _values(material: Any) -> tuple[float, float]:
    """Permittivity and conductivity in S/m."""
    permittivity, conductivity = (
        float(np.asarray(value).reshape(-1)[0])
        for value in (material.relative_permittivity, material.conductivity)
    )
    return permittivity, conductivity


def _held(scene: Any) -> float:
    return float(np.asarray(scene.frequency).reshape(-1)[0])
