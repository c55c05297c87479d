"""Write data so that ``dtprob.data.read`` gives them back."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dtprob.data.arrays import ArraySpec
from dtprob.data.kinds import (
    CHANNEL_ARRAYS,
    POWER_ARRAYS,
    ChannelData,
    Data,
    Labels,
    NetworkLog,
    PowerData,
)
from dtprob.errors import InputError
from dtprob.files import atomic_write


def write(path: str | os.PathLike[str], data: Data) -> None:
    """Write data to a file, whole or not at all.

    Args:
        path: .npz for any kind of data; .nc also for channels and powers; .csv and .parquet also for network
            logs and labels.
        data: what to write.

    Raises:
        InputError: a suffix that does not suit the data.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    arrays = file_arrays(data)
    if suffix == ".npz":
        # into a stream: the suffix of a name in capitals would be changed
        with atomic_write(path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)
    elif suffix == ".nc" and isinstance(data, ChannelData | PowerData):
        _write_netcdf(path, arrays, CHANNEL_ARRAYS if isinstance(data, ChannelData) else POWER_ARRAYS)
    elif suffix in {".csv", ".parquet"} and isinstance(data, NetworkLog | Labels):
        _write_columns(path, arrays)
    else:
        tabular = isinstance(data, NetworkLog | Labels)
        expected = ".npz, .csv or .parquet" if tabular else ".npz or .nc"
        raise InputError(
            str(path), f"the suffix {expected}", f"'{path.suffix}'", "Choose one of these formats"
        )


def file_arrays(data: Data) -> dict[str, np.ndarray]:
    """The arrays of a data file by their canonical names.

    A network log has a column per device, and labels have NaN where there is no label.
    """
    arrays = data.arrays()
    if isinstance(data, NetworkLog):
        columns = {"episode": data.episode, "slot": data.slot}
        for name in ("buffer", "action", "ack", "arrival"):
            columns |= {f"{name}_{device}": column for device, column in enumerate(arrays[name].T)}
        return columns
    if isinstance(data, Labels):
        columns = {f"x_{i}": column for i, column in enumerate(data.x.T)}
        columns["y"] = np.where(data.labelled, data.y, np.nan)
        names = "prediction", "weight", "context", "cluster"
        others = {name: getattr(data, name) for name in names}
        return columns | {name: values for name, values in others.items() if values is not None}
    return arrays


def _write_netcdf(path: Path, arrays: Mapping[str, np.ndarray], specs: Mapping[str, ArraySpec]) -> None:
    import xarray as xr  # noqa: PLC0415  (slow to import, needed for this format only)

    variables = {
        name: (
            tuple(str(axis) if isinstance(axis, str) else "coordinate" for axis in _axes(array, specs[name])),
            array,
        )
        for name, array in arrays.items()
    }
    with atomic_write(path) as temporary:
        xr.Dataset(variables).to_netcdf(temporary, engine="h5netcdf")


def _axes(array: np.ndarray, spec: ArraySpec) -> tuple[str | int, ...]:
    return next(shape for shape in spec.shapes if len(shape) == array.ndim)


def _write_columns(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    import pandas as pd  # noqa: PLC0415  (slow to import, needed for tables only)

    frame = pd.DataFrame(dict(arrays))
    with atomic_write(path) as temporary:
        if path.suffix.lower() == ".csv":
            frame.to_csv(temporary, index=False)
        else:
            frame.to_parquet(temporary, index=False)
