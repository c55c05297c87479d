"""Named arrays with declared axes: one table per kind of data, one check for all of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from dtprob.errors import InputError, unknown_name

type Axis = str | int
type NumberKind = Literal["complex", "real", "integer"]


@dataclass(frozen=True)
class ArraySpec:
    """What an array of a data file must look like.

    Attributes:
        shapes: the allowed shapes, as axis names (equal names have equal sizes) and fixed sizes.
        kind: the kind of number.
        required: whether the array must be there.
        lower: the smallest allowed value, if any.
        positive: whether zero is refused as well.
        missing: whether NaN may stand for a value that was not measured.
    """

    shapes: tuple[tuple[Axis, ...], ...]
    kind: NumberKind = "real"
    required: bool = False
    lower: float | None = None
    positive: bool = False
    missing: bool = False


_DTYPE = {"complex": np.complex128, "real": np.float64, "integer": np.int64}
_ACCEPTED = {"complex": "cfiu", "real": "fiub", "integer": "iub"}


def check_arrays(arrays: Mapping[str, object], specs: Mapping[str, ArraySpec]) -> dict[str, np.ndarray]:
    """Bring the arrays to their declared type and check them against ``specs``, in the order of ``specs``.

    Args:
        arrays: array-likes by name; a value of None counts as absent.
        specs: the declared arrays by name; the first ones fix the sizes of the axes.

    Returns:
        the arrays that are there, read-only, in double precision.

    Raises:
        InputError: an unknown name (the nearest valid one is named), a required array missing, a wrong type,
            rank or size, a NaN or infinity (with its first index), a value out of range.
    """
    given = {name: np.asarray(value) for name, value in arrays.items() if value is not None}
    for name in given:
        if name not in specs:
            raise unknown_name("array", name, specs, "array name")
    sizes: dict[str, int] = {}
    checked: dict[str, np.ndarray] = {}
    for name, spec in specs.items():
        if name in given:
            checked[name] = _check(name, given[name], spec, sizes)
        elif spec.required:
            shape = _show(spec.shapes[0], sizes)
            raise InputError(name, f"an array of shape {shape}", "nothing", "Add this array to the data")
    return checked


def side_by_side(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Columns of equal length as one array (row, column).

    Args:
        columns: by name.

    Raises:
        InputError: columns of other lengths than the first.
    """
    first, *_ = lengths = {name: np.shape(column) for name, column in columns.items()}
    for name, shape in lengths.items():
        if len(shape) != 1 or shape != lengths[first]:
            expected = f"{lengths[first][0] if lengths[first] else 1} values in a row, as {first} has"
            raise InputError(name, expected, f"shape {shape}", "Give all columns the same rows")
    return np.stack([np.asarray(column) for column in columns.values()], axis=1)


def _check(name: str, array: np.ndarray, spec: ArraySpec, sizes: dict[str, int]) -> np.ndarray:
    array = _convert(name, array, spec.kind)
    shape = _match(name, array.shape, spec.shapes, sizes)
    for axis, size in zip(shape, array.shape, strict=True):
        if isinstance(axis, str):
            sizes.setdefault(axis, size)
            if size == 0:
                raise InputError(
                    name, f"at least one {axis}", "an empty array", "Leave out what was not measured"
                )
    check_finite(name, array, allow_nan=spec.missing)
    _check_range(name, array, spec)
    array.setflags(write=False)
    return array


def _convert(name: str, array: np.ndarray, kind: NumberKind) -> np.ndarray:
    if array.dtype.kind == "f" and kind == "integer" and _is_whole(array):
        array = array.astype(np.int64)
    check_kind(name, array, kind)
    return array.astype(_DTYPE[kind])


def check_kind(name: str, array: np.ndarray, kind: NumberKind) -> None:
    """Raise an InputError that names the array and the first value that is no number of this kind, with its index."""
    if array.dtype.kind not in _ACCEPTED[kind]:
        raise InputError(name, f"{kind} numbers", _odd(array), f"Store {name} as {kind} numbers")


def _odd(array: np.ndarray) -> str:
    """The first value that is no number, or no whole one, or what all are."""
    if array.dtype.kind == "U":
        odd = np.reshape([bool(w) and not is_number(w) for w in array.flat], array.shape).astype(bool)
        others = "numbers as text" if array.size else "an empty array"
    elif array.dtype.kind == "f":
        odd, others = array != np.round(array), "numbers too large to be counted"
    else:
        odd, others = np.zeros(array.shape, bool), f"values of type {array.dtype}"
    if not odd.any():
        return others
    index = tuple(int(i) for i in np.argwhere(odd)[0])
    value = array[index].item()
    return f"{'NaN' if array.dtype.kind == 'f' and np.isnan(value) else repr(value)}{_at(index)}"


def is_number(value: Any) -> bool:
    """Whether a value, or what a word says, is a number."""
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True


def _at(index: tuple[int, ...]) -> str:
    return f" at index {index if len(index) != 1 else index[0]}" if index else ""


def _is_whole(array: np.ndarray) -> bool:
    """Whether all numbers are whole, and small enough to be told from their neighbours; infinity is not."""
    return bool(np.all(np.abs(array) < 2.0**53)) and np.array_equal(array, np.round(array))


def _match(
    name: str, shape: tuple[int, ...], allowed: tuple[tuple[Axis, ...], ...], sizes: Mapping[str, int]
) -> tuple[Axis, ...]:
    for candidate in allowed:
        if len(candidate) == len(shape) and all(
            sizes.get(axis, size) == size if isinstance(axis, str) else axis == size
            for axis, size in zip(candidate, shape, strict=True)
        ):
            return candidate
    expected = " or ".join(_show(candidate, sizes) for candidate in allowed)
    same_rank = any(len(candidate) == len(shape) for candidate in allowed)
    remedy = (
        f"Make the sizes of {name} agree with the other arrays" if same_rank else f"Give {name} these axes"
    )
    raise InputError(name, f"shape {expected}", str(shape), remedy)


def _show(shape: tuple[Axis, ...], sizes: Mapping[str, int]) -> str:
    if not shape:
        return "() (a scalar)"
    parts = [f"{axis}={sizes[axis]}" if axis in sizes else str(axis) for axis in map(_as_key, shape)]
    return f"({', '.join(parts)}{',' if len(parts) == 1 else ''})"


def _as_key(axis: Axis) -> str:
    return str(axis)


def check_finite(name: str, array: np.ndarray, *, allow_nan: bool = False) -> None:
    """Raise an InputError that names the array and the first index of a NaN or an infinity."""
    bad = ~np.isfinite(array)
    if allow_nan:
        bad &= ~np.isnan(array)
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        got = "NaN" if np.isnan(array[index]) else "infinity"
        raise InputError(
            name, "finite numbers", f"{got}{_at(index)}", "Remove or repair what was not measured"
        )


def _check_range(name: str, array: np.ndarray, spec: ArraySpec) -> None:
    if spec.lower is None or array.size == 0:
        return
    present = array[~np.isnan(array)] if spec.missing else array
    lowest = present.min() if present.size else spec.lower
    if lowest < spec.lower or (spec.positive and lowest == spec.lower):
        bound = (
            f"values {'above' if spec.positive else 'from'} {spec.lower:g}{'' if spec.positive else ' up'}"
        )
        raise InputError(name, bound, f"{lowest:g}", f"Check the unit and sign of {name}")
