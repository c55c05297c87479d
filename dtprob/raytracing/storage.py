"""Path sets on disk: NetCDF, readable anywhere, without the ray tracer and without code in the file."""

import json
import os
from pathlib import Path
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from dtprob.errors import InputError
from dtprob.files import atomic_write
from dtprob.raytracing.paths import DIMENSIONS, PathSet, validate

FORMAT: Final = "dtprob.paths"
FORMAT_VERSION: Final = 1
_OPTIONAL: Final = frozenset({"scattering", "object_center", "beyond"})
_REMEDY: Final = "Trace the scene again and save the path set with this version of dtprob"


def save(paths: PathSet, file: str | os.PathLike[str]) -> None:
    """Write a path set; the file is there whole or not at all.

    A complex array becomes two, ``name_real`` and ``name_imag``. What the paths come from (hash of the scene,
    settings of the solver) is kept with them.

    Args:
        paths: a valid path set.
        file: a name that ends in .nc.

    Raises:
        InputError: the path set is not valid.
    """
    validate(paths)
    variables: dict[str, tuple[tuple[str, ...], np.ndarray]] = {}
    for name, dims in DIMENSIONS.items():
        value = getattr(paths, name)
        if value is None:
            continue
        array = np.asarray(value)
        if np.iscomplexobj(array):
            variables[f"{name}_real"] = dims, array.real
            variables[f"{name}_imag"] = dims, array.imag
        else:
            variables[name] = dims, array.astype(np.uint8) if array.dtype == bool else array
    variables["object_name"] = ("object",), np.asarray(paths.object_names, dtype=object)
    variables["material_name"] = ("material",), np.asarray(paths.material_names, dtype=object)
    attributes = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "frequency": paths.frequency,
        "provenance": json.dumps(paths.provenance),
        "beyond_names": json.dumps(paths.beyond_names),
    }
    with atomic_write(file) as temporary:
        xr.Dataset(variables, attrs=attributes).to_netcdf(temporary, engine="h5netcdf")


def load(file: str | os.PathLike[str]) -> PathSet:
    """Read a path set written by `save`.

    Args:
        file: its name.

    Raises:
        InputError: there is no such file, or it holds no valid path set of a known version.
    """
    path = Path(file)
    if not path.is_file():
        raise InputError(f"path set {path}", "a NetCDF file", "no such file", "Correct the path")
    try:
        with xr.open_dataset(path, engine="h5netcdf") as opened:
            data = opened.load()
    except (OSError, ValueError) as error:
        raise InputError(f"path set {path}", "a NetCDF file", f"'{error}'", _REMEDY) from error
    _check_format(path, data)
    arrays: dict[str, Any] = {name: _array(path, data, name) for name in DIMENSIONS}
    return validate(PathSet(**arrays, **_described(path, data)))


def _check_format(path: Path, data: xr.Dataset) -> None:
    if data.attrs.get("format") != FORMAT:
        got = f"format '{data.attrs.get('format', 'none')}'"
        raise InputError(f"path set {path}", f"format '{FORMAT}'", got, _REMEDY)
    number = int(data.attrs.get("format_version", 0))
    if number != FORMAT_VERSION:
        expected = f"format_version {FORMAT_VERSION}"
        raise InputError(f"path set {path}", expected, f"format_version {number}", _REMEDY)


def _described(path: Path, data: xr.Dataset) -> dict[str, Any]:
    """What a path set holds beside its arrays."""
    missing = [name for name in ("object_name", "material_name") if name not in data]
    missing += [name for name in ("frequency", "provenance") if name not in data.attrs]
    if missing:
        raise InputError(f"path set {path}", f"'{missing[0]}'", "none", _REMEDY)
    try:
        return {
            "frequency": float(data.attrs["frequency"]),
            "object_names": tuple(map(str, data["object_name"].to_numpy())),
            "material_names": tuple(map(str, data["material_name"].to_numpy())),
            "beyond_names": tuple(json.loads(data.attrs.get("beyond_names", "[]"))),
            "provenance": tuple((name, value) for name, value in json.loads(data.attrs["provenance"])),
        }
    except (ValueError, TypeError) as error:
        expected = "a frequency in Hz, and beyond_names and provenance in JSON"
        raise InputError(f"path set {path}", expected, f"'{error}'", _REMEDY) from error


def _array(path: Path, data: xr.Dataset, name: str) -> Array | None:
    if name in data:
        value = data[name].to_numpy()
        return jnp.asarray(value.astype(bool) if name == "mask" else value)
    if f"{name}_real" in data and f"{name}_imag" in data:
        return jnp.asarray(data[f"{name}_real"].to_numpy() + 1j * data[f"{name}_imag"].to_numpy())
    if name in _OPTIONAL:
        return None
    raise InputError(f"path set {path}", f"an array '{name}'", "none", _REMEDY)
