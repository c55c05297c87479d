"""A repair of sionna-rt 2.2.0, to use wherever it computes fields or draws events by their power.

Its complex square root subtracts near equals in single precision, so that the conductivity of a material of
low loss is rounded away: the field is that of another material, and the derivative by a conductivity of
2e-4 S/m is 85% too small.
"""

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any


def stable_square_root(x: Any) -> Any:
    """The principal square root of a Mitsuba complex number, with neither part a difference of near equals.

    Args:
        x: a ``mitsuba.Complex2f``.
    """
    import drjit as dr  # noqa: PLC0415

    real, imaginary = dr.real(x), dr.imag(x)
    magnitude = dr.sqrt(dr.square(real) + dr.square(imaginary))
    major = dr.sqrt(0.5 * (magnitude + dr.abs(real)))
    minor = dr.select(major > 0, 0.5 * imaginary / dr.select(major > 0, major, 1.0), 0.0)
    sign = dr.select(imaginary < 0, -1.0, 1.0)
    positive = real >= 0
    return type(x)(dr.select(positive, major, dr.abs(minor)), dr.select(positive, minor, sign * major))


@contextmanager
def repaired_sionna() -> Generator[None]:
    """Compute with the repaired square root inside the context, as sionna-rt ships it outside."""
    from sionna.rt.utils import electromagnetics  # noqa: PLC0415

    original = electromagnetics.complex_sqrt
    electromagnetics.complex_sqrt = stable_square_root
    try:
        yield
    finally:
        electromagnetics.complex_sqrt = original
