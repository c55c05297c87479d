"""The one door to sionna-rt: LLVM is chosen before it is imported, and its absence is said clearly."""

from typing import Any

from dtprob.errors import InputError
from dtprob.raytracing.llvm import prepare_llvm


def sionna_rt() -> Any:
    """The module ``sionna.rt``, imported when first asked for.

    Raises:
        InputError: sionna-rt is not installed, or no LLVM library works.
    """
    prepare_llvm()
    try:
        from sionna import rt  # noqa: PLC0415
    except ModuleNotFoundError as error:
        if error.name not in {"sionna", "sionna.rt", "mitsuba", "drjit"}:
            raise
        remedy = "Install it with `pip install sionna-rt`, or use a path set traced elsewhere"
        raise InputError("ray tracer", "the package sionna-rt", f"no module {error.name}", remedy) from error
    return rt
