"""Files to named arrays, whatever the format. No format that can run code is read."""

import csv
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dtprob.errors import InputError

type Arrays = dict[str, np.ndarray]

_PACKED = ("scale_factor", "add_offset", "_FillValue", "missing_value")
_TIME = re.compile(r"(\w+) since \d")
_SECONDS = {
    **dict.fromkeys(("days", "day", "d"), 86400),
    **dict.fromkeys(("hours", "hour", "h", "hr", "hrs"), 3600),
    **dict.fromkeys(("minutes", "minute", "min", "mins"), 60),
    **dict.fromkeys(("seconds", "second", "s", "sec", "secs"), 1),
    **dict.fromkeys(("milliseconds", "millisecond", "ms", "msec", "msecs"), 1e-3),
    **dict.fromkeys(("microseconds", "microsecond"), 1e-6),
    **dict.fromkeys(("nanoseconds", "nanosecond"), 1e-9),
}
"""Units of points in time as the conventions of NetCDF name them."""
_NETCDF_DIMENSION_ONLY = b"This is a netCDF dimension but not a netCDF variable"


def load_arrays(path: Path) -> Arrays:
    """All arrays (or columns) of a file by name.

    Args:
        path: a file of a format in ``FORMATS``, told by its suffix.

    Returns:
        the arrays as stored; columns of a table as 1-D arrays; text as NumPy text.

    Raises:
        InputError: no such file, an unknown format, a file that is damaged or holds Python objects.
    """
    if not path.exists():
        raise InputError(str(path), "a data file", "no such file", "Check the name and the folder")
    reader = FORMATS.get(path.suffix.lower())
    if reader is None:
        got = f"the suffix '{path.suffix}'"
        raise InputError(
            str(path), f"one of {', '.join(FORMATS)}", got, "Save the data in one of these formats"
        )
    try:
        arrays = reader(path)
    except InputError:
        raise
    except ImportError as error:
        remedy = _EXTRA.get(path.suffix.lower(), "Install dtprob again, with all that it needs")
        raise InputError(str(path), "a format that can be read here", str(error), remedy) from error
    except Exception as error:
        reason = str(error).split("\n", maxsplit=1)[0].rstrip(".") or type(error).__name__
        raise InputError(
            str(path), f"a readable {path.suffix} file", reason, "Write the file again"
        ) from error
    if not arrays:
        raise InputError(str(path), "named arrays", "none", "Write the arrays under their names")
    return arrays


_UNNAMED = "column without a name, the {}th from 0"
_EXTRA = {".zarr": "Install it with: pip install zarr"}
"""What brings the package that a format needs, of formats whose package does not come along."""


def _refuse_objects(path: Path, name: str) -> InputError:
    got = f"Python objects (a pickle) in '{name}'"
    return InputError(
        str(path), "plain arrays", got, "Store numbers only; a pickle can run code and is not read"
    )


def _read_npz(path: Path) -> Arrays:
    if not zipfile.is_zipfile(path):
        raise InputError(str(path), "an NPZ archive", "another kind of file", "Write it with numpy.savez")
    arrays: Arrays = {}
    with np.load(path, allow_pickle=False) as archive:
        for name in archive.files:
            try:
                arrays[name] = archive[name]
            except ValueError as error:
                if "pickle" in str(error).lower():
                    raise _refuse_objects(path, name) from error
                raise
    return arrays


def _read_hdf5(path: Path) -> Arrays:
    import h5py  # noqa: PLC0415  (loaded only for this format)

    arrays: Arrays = {}
    with h5py.File(path, "r") as file:
        groups = [name for name, item in file.items() if isinstance(item, h5py.Group) and name != "#refs#"]
        if groups and len(groups) == len(file):
            got, remedy = f"the group {groups[0]!r} alone", "Write the arrays at the top of the file"
            raise InputError(str(path), "named arrays", got, remedy)
        for name, item in file.items():
            if not isinstance(item, h5py.Dataset) or _NETCDF_DIMENSION_ONLY in _attribute(item, "NAME"):
                continue
            array = np.asarray(item.asstr()[...] if h5py.check_string_dtype(item.dtype) else item[...])
            arrays[name] = array.astype(str) if array.dtype.kind == "O" else _meant(array, item.attrs)
            if "MATLAB_class" in item.attrs:
                arrays[name] = arrays[name].T
    return arrays


def dimension_scales(path: Path) -> set[str]:
    """Names of the arrays of a NetCDF or HDF5 file that only number the entries along a dimension; none of other files."""
    import h5py  # noqa: PLC0415  (loaded only for this format)

    if path.suffix.lower() not in {".nc", ".h5", ".hdf5"}:
        return set()
    if _is_classic(path):
        from scipy.io import netcdf_file  # noqa: PLC0415  (loaded only for this format)

        with netcdf_file(path, mmap=False) as file:
            return {name for name, variable in file.variables.items() if name in variable.dimensions}
    with h5py.File(path, "r") as file:
        told = {name for name, item in file.items() if _attribute(item, "CLASS") == b"DIMENSION_SCALE"}
        return {name for name in told if _NETCDF_DIMENSION_ONLY not in _attribute(file[name], "NAME")}


def _is_classic(path: Path) -> bool:
    """Whether a file is of NetCDF's own format, version 1 or 2; version 4 is HDF5."""
    with path.open("rb") as file:
        return file.read(4) in {b"CDF\x01", b"CDF\x02"}


def _read_netcdf(path: Path) -> Arrays:
    if not _is_classic(path):
        return _read_hdf5(path)
    from scipy.io import netcdf_file  # noqa: PLC0415  (loaded only for this format)

    arrays: Arrays = {}
    with netcdf_file(path, mmap=False) as file:
        for name, variable in file.variables.items():
            array = np.array(variable[...])
            if array.dtype.kind == "S":
                words = array.reshape(-1, array.shape[-1]).tolist() if array.ndim else [[array.item()]]
                text = [b"".join(word).rstrip(b"\x00").decode() for word in words]
                arrays[name] = np.array(text, str).reshape(array.shape[:-1])
                continue
            attributes = {n: getattr(variable, n) for n in (*_PACKED, "units") if hasattr(variable, n)}
            arrays[name] = _meant(array.astype(array.dtype.newbyteorder("=")), attributes)
    return arrays


def _attribute(item: Any, name: str) -> bytes:
    value = item.attrs.get(name, b"")
    return value.encode() if isinstance(value, str) else bytes(value)


def _meant(array: np.ndarray, attributes: Mapping[str, Any]) -> np.ndarray:
    """The numbers that stored ones stand for: packed or missing by the conventions of NetCDF, empty by MATLAB's."""
    if attributes.get("MATLAB_empty"):
        return np.zeros(tuple(map(int, array[::-1])))  # what is stored is the shape, in MATLAB's order
    if array.dtype.kind not in "fiu":
        return _plain_complex(array)
    told = {name: np.ravel(attributes[name])[0] for name in _PACKED if name in attributes}
    absent = [array == told[name] for name in ("_FillValue", "missing_value") if name in told]
    if "scale_factor" in told or "add_offset" in told:
        array = array * float(told.get("scale_factor", 1.0)) + float(told.get("add_offset", 0.0))
    seconds = _seconds(attributes)
    array = array if seconds == 1 else array.astype(float) * seconds
    return np.where(np.any(absent, axis=0), np.nan, array) if np.any(absent) else array


def _seconds(attributes: Mapping[str, Any]) -> float | int:
    """Seconds in the unit of points in time, such as "hours since 2024-01-01"; 1 of anything else.

    Raises:
        InputError: months or years, which have no length of their own.
    """
    units = attributes.get("units", "")
    found = _TIME.match(units.decode() if isinstance(units, bytes) else str(units))
    if found is None:
        return 1
    word = found[1].lower()
    if word in {"months", "month", "years", "year"}:
        expected, got = "days, hours, minutes, seconds or parts of one", f"{found[1]} since a date"
        raise InputError("units of a point in time", expected, got, "Write times as seconds")
    return _SECONDS.get(word, 1)


def _plain_complex(array: np.ndarray) -> np.ndarray:
    """Turn a (real, imaginary) pair of fields into complex numbers."""
    for real, imaginary in (("r", "i"), ("real", "imag")):
        if array.dtype.names == (real, imaginary):
            return array[real] + 1j * array[imaginary]
    return array


def _read_mat(path: Path) -> Arrays:
    from scipy.io import loadmat  # noqa: PLC0415  (loaded only for this format)

    try:
        stored = loadmat(path)
    except NotImplementedError:  # version 7.3 is HDF5
        return _read_hdf5(path)
    return {name: np.asarray(value) for name, value in stored.items() if not name.startswith("__")}


def _read_zarr(path: Path) -> Arrays:
    import zarr  # noqa: PLC0415  (an optional extra)

    for metadata in [*path.rglob(".z*"), *path.rglob("zarr.json")]:
        if metadata.is_file() and '"pickle"' in metadata.read_text(errors="replace"):
            raise _refuse_objects(path, metadata.parent.name)
    group = zarr.open_group(path, mode="r")
    return {name: np.asarray(array[...]) for name, array in group.arrays()}


def _read_csv(path: Path) -> Arrays:
    import pandas as pd  # noqa: PLC0415  (slow to import, needed for tables only)

    _check_text(path)
    first = pd.read_csv(path, header=None, nrows=1, dtype=str, keep_default_na=False).iloc[0]
    header = [name.strip() for name in first]
    twice = sorted({name for name in header if name and header.count(name) > 1})
    if twice:
        raise InputError(str(path), "columns of different names", f"{twice[0]!r} twice", "Rename one of them")
    if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
        got, remedy = f"one, {header[0]!r}", "Write commas for semicolons or tabs, and points in numbers"
        raise InputError(str(path), "columns that commas separate", got, remedy)
    try:
        second = pd.read_csv(path, header=None, skiprows=1, nrows=1).iloc[0].tolist()
    except pd.errors.EmptyDataError:
        raise InputError(
            str(path), "a row for each reading", "a header alone", "Write what was measured"
        ) from None
    if not all(pd.isna(cell) for cell in second[len(header) :]):
        got = f"{len(second)} cells in the first row, {len(header)} names"
        remedy = "Name every column in the first line, and write points in numbers"
        raise InputError(str(path), "a name for each column", got, remedy)
    _check_lengths(path, len(header))
    names = [name or _UNNAMED.format(i) for i, name in enumerate(header)]
    unnamed = [name for name in names if name not in header]
    layout: Any = {"header": 0, "names": names, "usecols": range(len(names))}
    table = pd.read_csv(path, **layout)
    absent = [name for name in names if table[name].dtype.kind not in "biuf" and table[name].isna().any()]
    if absent:  # among words NA and None are words
        table[absent] = pd.read_csv(path, **layout, dtype=str, keep_default_na=False)[absent]
    return _columns(table.drop(columns=[name for name in unnamed if bool(table[name].isna().all())]))


def _check_text(path: Path) -> None:
    """Refuse what is empty or no UTF-8."""
    try:
        with path.open(encoding="utf-8") as file:
            has_text = (
                sum(bool(line.strip("\ufeff \t\r\n")) for line in file) > 0
            )  # of all lines the encoding is seen
    except UnicodeDecodeError as error:
        got = f"another encoding (byte {error.start})"
        raise InputError(str(path), "a table in UTF-8", got, "Save it as UTF-8") from None
    if not has_text:
        raise InputError(
            str(path), "a header and a row for each reading", "no text", "Write what was measured"
        )


def _check_lengths(path: Path, width: int) -> None:
    """Refuse rows with more cells than there are names: of these pandas drops the last ones without a word."""
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        lines = csv.reader(file)
        for row in lines:
            if any(cell.strip() for cell in row[width:]):
                got, remedy = f"{len(row)}", "Write points in numbers, and quote words that hold commas"
                raise InputError(
                    f"{path}, line {lines.line_num}", f"{width} cells as in the first line", got, remedy
                )


def _read_parquet(path: Path) -> Arrays:
    import pyarrow.parquet as pq  # noqa: PLC0415  (slow to import, needed for tables only)

    return _columns(pq.read_table(path).to_pandas(ignore_metadata=True))


def _columns(frame: Any) -> Arrays:
    columns: Arrays = {}
    for name in frame.columns:
        column = frame[name]
        if column.dtype.kind in "biuf":
            columns[str(name)] = column.to_numpy(dtype=float if column.dtype.kind == "f" else None)
        else:
            words = ["" if absent else str(word) for word, absent in zip(column, column.isna(), strict=True)]
            columns[str(name)] = np.array(words, dtype=str)
    return columns


FORMATS: Mapping[str, Callable[[Path], Arrays]] = {
    ".npz": _read_npz,
    ".h5": _read_hdf5,
    ".hdf5": _read_hdf5,
    ".nc": _read_netcdf,
    ".zarr": _read_zarr,
    ".mat": _read_mat,
    ".csv": _read_csv,
    ".parquet": _read_parquet,
}
"""How each suffix is read."""
