"""A posterior as an ArviZ DataTree and as a NetCDF file.

The file is the DataTree, so that ArviZ and xarray read it as it is. What a DataTree cannot hold (complex
numbers, two sizes of one axis, slashes in names) is written in another form, with attributes that say how to go back.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from dtprob.errors import InputError
from dtprob.files import atomic_write
from dtprob.inference.posterior import Posterior
from dtprob.models.axes import unnamed_axes

FORMAT = "dtprob posterior 1"
_ENGINE = "h5netcdf"
_LEADING = ("chain", "draw")
_PARTS = ("real", "imag")


def to_datatree(posterior: Posterior) -> xr.DataTree:
    """The posterior as a DataTree; see `Posterior.to_datatree`."""
    axes = posterior.axes
    groups = {
        "posterior": _dataset(posterior.draws, axes, _LEADING, posterior.coords),
        "sample_stats": _dataset(posterior.sample_stats, axes, _LEADING, {}),
        "log_likelihood": _dataset(posterior.log_likelihood, axes, _LEADING, posterior.coords),
        "observed_data": _dataset(posterior.observed, axes, (), posterior.coords),
        "constant_data": _dataset(posterior.constant, axes, (), posterior.coords),
        "posterior_predictive": _dataset(posterior.predicted, axes, _LEADING, posterior.coords),
        "extra": _dataset(posterior.extra, {}, (), {}),
    }
    filled = {name: dataset for name, dataset in groups.items() if name == "posterior" or dataset.data_vars}
    written = without_slashes(filled.values())
    tree = xr.DataTree.from_dict({name: renamed(dataset, written) for name, dataset in filled.items()})
    tree.attrs = {
        "format": FORMAT,
        "provenance": json.dumps(posterior.provenance, sort_keys=True),
        "axes": json.dumps({name: list(names) for name, names in axes.items()}),
        "latent": json.dumps(list(posterior.latent)),
        "circular": json.dumps(list(posterior.circular)),
        "counted": json.dumps(sorted(_counted(filled.values(), posterior.coords))),
        "names": json.dumps({new: old for old, new in written.items()}),
    }
    return tree


def save(posterior: Posterior, path: Path) -> None:
    """Write the posterior's DataTree to NetCDF, whole or not at all."""
    tree = to_datatree(posterior)
    with atomic_write(path) as temporary:
        tree.to_netcdf(temporary, engine=_ENGINE)


def load(path: Path) -> Posterior:
    """Read a posterior; see `Posterior.load`."""
    if not path.is_file():
        raise InputError(f"posterior file {path}", "an existing file", "none", "Check the path")
    try:
        with xr.open_datatree(path, engine=_ENGINE) as opened:
            tree = opened.load()
    except (OSError, ValueError) as error:
        remedy = "Give a file that Posterior.save wrote"
        raise InputError(f"posterior file {path}", "NetCDF", str(error).splitlines()[0], remedy) from error
    return from_datatree(tree, f"posterior file {path}")


def from_datatree(tree: xr.DataTree, what: str = "data tree") -> Posterior:
    """The posterior that `to_datatree` made a tree of.

    Args:
        tree: the tree.
        what: its name in error messages.

    Raises:
        InputError: the tree is not one of dtprob's, or of another version of the format.
    """
    found = tree.attrs.get("format")
    if found != FORMAT:
        remedy = "Read it with the version of dtprob that wrote it, or with arviz"
        raise InputError(what, f"format '{FORMAT}'", repr(found), remedy)
    names = json.loads(tree.attrs.get("names", "{}"))
    groups = {group: renamed(child.to_dataset(), names) for group, child in tree.children.items()}
    arrays = {group: _arrays(dataset) for group, dataset in groups.items()}
    counted = {*_LEADING, *json.loads(tree.attrs.get("counted", "[]"))}
    coords = {
        str(name): value.values
        for dataset in groups.values()
        for name, value in dataset.coords.items()
        if name not in counted
    }
    return Posterior(
        draws=arrays.get("posterior", {}),
        sample_stats=arrays.get("sample_stats", {}),
        log_likelihood=arrays.get("log_likelihood", {}),
        observed=arrays.get("observed_data", {}),
        constant=arrays.get("constant_data", {}),
        predicted=arrays.get("posterior_predictive", {}),
        axes={name: tuple(names) for name, names in json.loads(tree.attrs["axes"]).items()},
        latent=tuple(json.loads(tree.attrs["latent"])),
        circular=tuple(json.loads(tree.attrs["circular"])),
        coords=coords,
        extra=arrays.get("extra", {}),
        provenance=json.loads(tree.attrs["provenance"]),
    )


def without_slashes(datasets: Iterable[xr.Dataset]) -> dict[str, str]:
    """How names with slashes, as of sites within `numpyro.handlers.scope`, are written: a tree cannot hold them."""
    names = {str(name) for dataset in datasets for name in (*dataset.variables, *dataset.dims)}
    written: dict[str, str] = {}
    for name in sorted(name for name in names if "/" in name):
        free = name.replace("/", ".")
        while free in names:
            free += "."
        names.add(free)
        written[name] = free
    return written


def renamed(dataset: xr.Dataset, names: Mapping[str, str]) -> xr.Dataset:
    """The dataset with those of its variables and axes renamed that have another name in `names`."""
    return dataset.rename({o: n for o, n in names.items() if o in dataset.variables or o in dataset.dims})


def _dataset(
    values: Mapping[str, Any],
    axes: Mapping[str, tuple[str, ...]],
    leading: tuple[str, ...],
    coords: Mapping[str, np.ndarray],
) -> xr.Dataset:
    arrays = {name: np.asarray(value) for name, value in values.items()}
    dims = _dimensions(arrays, axes, leading)
    variables: dict[str, xr.Variable] = {}
    for name, array in arrays.items():
        for key, part in _parts(name, array):
            attributes = {"complex_of": name} if np.iscomplexobj(array) else {}
            variables[key] = xr.Variable(dims[name], part, attributes)
    sizes = {dim: size for v in variables.values() for dim, size in zip(v.dims, v.shape, strict=True)}
    known = {str(d): np.arange(n) for d, n in sizes.items() if d not in variables}
    known |= {d: np.asarray(c) for d, c in coords.items() if sizes.get(d) == len(c)}
    return xr.Dataset(variables, coords=known)


def _counted(datasets: Iterable[xr.Dataset], coords: Mapping[str, np.ndarray]) -> set[str]:
    """Axes whose values only count their entries, for ArviZ, which selects by values."""
    return {str(name) for dataset in datasets for name in dataset.coords if name not in coords}


def _parts(name: str, array: np.ndarray) -> Iterable[tuple[str, np.ndarray]]:
    if not np.iscomplexobj(array):
        return [(name, array)]
    return [(f"{name}.{part}", np.ascontiguousarray(getattr(array, part))) for part in _PARTS]


def _dimensions(
    arrays: Mapping[str, np.ndarray], axes: Mapping[str, tuple[str, ...]], leading: tuple[str, ...]
) -> dict[str, tuple[str, ...]]:
    """Names of every variable's dimensions: the axes, made distinct where one name has two sizes.

    The largest size keeps the name; another size n of the axis `a` is called `a.n`, and a second `a` in one
    variable `a.2`.
    """
    wanted: dict[str, tuple[str, ...]] = {}
    largest: dict[str, int] = {}
    for name, array in arrays.items():
        rest = array.ndim - len(leading)
        given = tuple(axes.get(name, ()))
        wanted[name] = given if len(given) == rest else unnamed_axes(name, rest)
        for axis, size in zip(wanted[name], array.shape[len(leading) :], strict=True):
            largest[axis] = max(size, largest.get(axis, 0))
    chosen: dict[str, tuple[str, ...]] = {}
    for name, names in wanted.items():
        used = list(leading)
        for axis, size in zip(names, arrays[name].shape[len(leading) :], strict=True):
            label = axis if size == largest[axis] else f"{axis}.{size}"
            used.append(label if label not in used else f"{label}.{used.count(label) + 1}")
        chosen[name] = tuple(used)
    return chosen


def _arrays(dataset: xr.Dataset) -> dict[str, np.ndarray]:
    arrays: dict[str, np.ndarray] = {}
    for key, variable in dataset.data_vars.items():
        name = variable.attrs.get("complex_of")
        if name is None:
            arrays[str(key)] = variable.values
        elif name not in arrays:
            real, imag = (dataset[f"{name}.{part}"].values for part in _PARTS)
            arrays[name] = real + 1j * imag
    return arrays
