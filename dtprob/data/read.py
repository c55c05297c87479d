"""Read a data file and tell its kind by what is in it."""

import os
import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from dtprob.data import network, uwb_apartment
from dtprob.data.arrays import ArraySpec, check_kind, side_by_side
from dtprob.data.formats import Arrays, dimension_scales, load_arrays
from dtprob.data.kinds import (
    CHANNEL_ARRAYS,
    LABEL_ARRAYS,
    POWER_ARRAYS,
    ChannelData,
    Data,
    Labels,
    PowerData,
    Table,
)
from dtprob.errors import InputError, unknown_name

_CANONICAL: Final = {*CHANNEL_ARRAYS, *POWER_ARRAYS, "power_db", "power_reference"}


def read(path: str | os.PathLike[str], options: Mapping[str, Any] | None = None) -> Data:
    """Read channels, powers, a network log, labels or a table of other columns.

    The kind is told by the names in the file: ``channel`` makes it ``ChannelData``, ``power`` or ``power_db``
    ``PowerData``, ``episode``, ``slot`` or ``buffer_0`` a ``NetworkLog``, ``y`` with ``x`` (or ``x_0``, ...)
    ``Labels``; anything else is a ``Table``.

    Args:
        path: an .npz, .h5, .hdf5, .nc, .zarr, .mat, .csv or .parquet file, or the folder of the measured set
            ``uwb_apartment`` (read by ``dtprob.data.uwb_apartment.channels``).
        options: settings of the reader; the measured set has ``links``, ``averages``, ``level``, network logs
            have ``allow_gaps``, which splits episodes where slots are missing.

    Raises:
        InputError: no such file, a format that is not read, a file that holds Python objects, or arrays that
            are not what their names say (the array is named, and the first index where that helps).
    """
    path = Path(path)
    if (path / uwb_apartment.RESPONSES).is_file():
        return uwb_apartment.channels(path, **_known(options or {}, ("links", "averages", "level"), path))
    arrays = load_arrays(path)
    if {"channel", "power", "power_db"} & set(arrays):
        for name in dimension_scales(path) - _CANONICAL:
            del arrays[name]
    chosen = _known(options or {}, ("allow_gaps",) if _is_log(arrays) else (), path)
    try:
        return _interpret(arrays, chosen, matlab=_is_matlab(path))
    except InputError as error:
        raise InputError(f"{path.name}: {error.what}", error.expected, error.got, error.remedy) from None


def _known(options: Mapping[str, Any], valid: tuple[str, ...], path: Path) -> dict[str, Any]:
    for name in options:
        if not valid:
            raise InputError(f"options of {path.name}", "none", name, "Leave the options out")
        if name not in valid:
            raise unknown_name(f"options of {path.name}", name, valid, "option")
    return dict(options)


def read_table(path: str | os.PathLike[str], options: Mapping[str, Any] | None = None) -> Table:
    """Read a file as columns or arrays by name, without asking what they mean.

    Args:
        path: a file of any format that ``read`` knows.
        options: of the reader, of which there are none.

    Raises:
        InputError: as ``read``.
    """
    path = Path(path)
    _known(options or {}, (), path)
    arrays = load_arrays(path)
    try:
        return Table(_columns(arrays, matlab=_is_matlab(path)))
    except InputError as error:
        raise InputError(f"{path.name}: {error.what}", error.expected, error.got, error.remedy) from None


def _is_matlab(path: Path) -> bool:
    return path.suffix.lower() == ".mat"


def _is_log(names: Iterable[str]) -> bool:
    return not {"channel", "power", "power_db"} & set(names) and bool(
        {"episode", "slot", "buffer_0"} & set(names)
    )


def _interpret(arrays: Arrays, options: Mapping[str, Any], *, matlab: bool) -> Data:
    names = set(arrays)
    if "channel" in names:
        return _channels(arrays, matlab=matlab)
    if names & {"power", "power_db"}:
        return _powers(arrays, matlab=matlab)
    if _is_log(names):
        return network.from_columns(_columns(arrays, matlab=matlab), **options)
    if "y" in names and names & {"x", "x_0"}:
        return _labels(arrays, matlab=matlab)
    if names & set(CHANNEL_ARRAYS):
        _check_names(arrays, _CANONICAL)
        return _channels(arrays, matlab=matlab)
    try:
        return Table(_columns(arrays, matlab=matlab))
    except InputError as error:
        is_missing = error.expected == "finite numbers"
        hint = "; or if these are labels, name them y and the features x_0, x_1, ..." if is_missing else ""
        remedy = f"{error.remedy}{hint}"
        raise InputError(error.what, error.expected, error.got, remedy) from None


def _check_names(arrays: Arrays, known: Collection[str], valid: Collection[str] = ()) -> None:
    """Refuse the first array whose name is not known.

    Args:
        arrays: by name.
        known: the names that may be there.
        valid: the names that a user can write, where they are others.

    Raises:
        InputError: see above.
    """
    for name in arrays:
        if name not in known:
            raise unknown_name("array", name, valid or known, "array name")


def _channels(arrays: Arrays, *, matlab: bool) -> ChannelData:
    _check_names(arrays, CHANNEL_ARRAYS)
    if "channel" not in arrays:
        shape = "(link, snapshot, rx_antenna, tx_antenna, subcarrier)"
        raise InputError("channel", f"an array of shape {shape}", "nothing", "Add this array to the data")
    check_kind("channel", arrays["channel"], "complex")
    if arrays["channel"].dtype.kind != "c" or (
        arrays["channel"].any() and not np.imag(arrays["channel"]).any()
    ):
        remedy = (
            "Store amplitude and phase, as amplitude * exp(1j * phase in rad), or received powers as 'power'"
        )
        raise InputError("channel", "complex coefficients", "real numbers", remedy)
    if arrays["channel"].size and not arrays["channel"].any():
        raise InputError("channel", "measured coefficients", "zeros alone", "Store what was measured")
    return ChannelData(**_canonical(arrays, CHANNEL_ARRAYS, matlab=matlab))


def _powers(arrays: Arrays, *, matlab: bool) -> PowerData:
    arrays = dict(arrays)
    decibels, reference = arrays.pop("power_db", None), arrays.pop("power_reference", None)
    if (decibels is None) != (reference is None):
        have, lack = ("power_db", "power_reference") if reference is None else ("power_reference", "power_db")
        remedy = (
            "Give power_db with power_reference, the linear power (W) of 0 dB: 1e-3 for dBm, 1 for a ratio"
        )
        raise InputError(lack, f"a value beside {have}", "nothing", remedy)
    if decibels is not None and reference is not None:
        if "power" in arrays:
            raise InputError("power_db", "either power or power_db", "both", "Leave one of them out")
        _numeric("power_db", decibels)
        _numeric("power_reference", reference)
        if reference.size != 1:
            raise InputError(
                "power_reference", "one number", f"shape {reference.shape}", "Give the power of 0 dB"
            )
        if not reference.item() > 0:
            expected, remedy = "a positive linear power (W), that of 0 dB", "Give 1e-3 for dBm, 1 for a ratio"
            raise InputError("power_reference", expected, f"{reference.item():g}", remedy)
        arrays["power"] = reference.item() * 10.0 ** (np.asarray(decibels, dtype=float) / 10.0)
    _check_names(arrays, POWER_ARRAYS, [*POWER_ARRAYS, "power_db", "power_reference"])
    given = arrays.get("power")
    if given is not None and given.dtype.kind in "fiu" and (given < 0).any():
        remedy = (
            "Give levels in dB as power_db, with power_reference, the linear power (W) of 0 dB: 1e-3 for dBm"
        )
        raise InputError("power", "linear values from 0 up", f"{given.min():g}", remedy)
    return PowerData(**_canonical(arrays, POWER_ARRAYS, matlab=matlab))


def _numeric(name: str, array: np.ndarray) -> None:
    """Refuse what is no real number; of yes and no nobody knows what they measure."""
    check_kind(name, array, "real")
    if array.dtype.kind == "b":
        raise InputError(name, "real numbers", "yes and no", f"Store {name} as real numbers")


def _labels(arrays: Arrays, *, matlab: bool) -> Labels:
    arrays = dict(arrays)
    numbered = sorted(
        (name for name in arrays if re.fullmatch(r"x_\d+", name)), key=lambda name: int(name[2:])
    )
    if numbered and "x" not in arrays:
        if numbered != [f"x_{i}" for i in range(len(numbered))]:
            raise InputError(
                "x", f"columns x_0 to x_{len(numbered) - 1}", ", ".join(numbered), "Number them from 0"
            )
        columns = {name: arrays.pop(name) for name in numbered}
        arrays["x"] = side_by_side(_columns(columns, matlab=matlab))
    optional = ("prediction", "weight", "context", "cluster")
    for name in arrays:
        if name not in {"x", "y", *optional}:
            raise unknown_name("array", name, ["x", "y", *optional], "array name")
    arrays = _canonical(arrays, LABEL_ARRAYS, matlab=matlab)
    if arrays["x"].ndim == 1:
        arrays["x"] = arrays["x"][:, None]
    _numeric("y", arrays["y"])
    y = np.asarray(arrays["y"], dtype=float)
    labelled = ~np.isnan(y)
    others = {name: arrays.get(name) for name in optional}
    return Labels(x=arrays["x"], y=np.where(labelled, y, 0.0), labelled=labelled, **others)


def _canonical(arrays: Arrays, specs: Mapping[str, ArraySpec], *, matlab: bool) -> Arrays:
    """Undo what MATLAB does to shapes: it has no vectors and drops trailing axes of size one."""
    return (
        {name: _matlab_shape(array, specs[name]) for name, array in arrays.items()}
        if matlab
        else dict(arrays)
    )


def _columns(arrays: Arrays, *, matlab: bool) -> Arrays:
    """Columns of a table, which MATLAB has as matrices with one row or one column."""
    flat = {name: array.ndim == 2 and 1 in array.shape for name, array in arrays.items() if matlab}
    return {name: array.reshape(-1) if flat.get(name) else array for name, array in arrays.items()}


def _matlab_shape(array: np.ndarray, spec: ArraySpec) -> np.ndarray:
    lowest, highest = min(map(len, spec.shapes)), max(map(len, spec.shapes))
    if highest <= 1 and array.ndim == 2 and 1 in array.shape:
        return array.reshape(() if lowest == 0 and array.size == 1 else (-1,))
    return array.reshape(array.shape + (1,) * max(0, highest - array.ndim))
