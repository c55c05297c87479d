"""Path sets of DeepMIMO, version 4: a scenario's folder of matrices, or the dictionary that its Python package gives.

A folder holds params.json, with `rt_params.frequency` in Hz, and a file per matrix and pair of transmitter and receiver
set, `<key>_t<set>_tx<index>_r<set>.npz` or `.mat`, each with one array under its key:

    rx_pos (n, 3), tx_pos (3,) or (1, 3)                m
    power (n, path)                                     dB relative to the power sent
    phase (n, path)                                     deg, at the carrier; without that of the delay in scenarios
                                                        converted from Sionna RT, whose `Paths.a` has none
    delay (n, path)                                     s
    aoa_az, aoa_el, aod_az, aod_el (n, path)            deg; `_el` is the angle from the z axis, and angles of arrival
                                                        point to where the wave comes from
    inter, inter_pos                                    not read: gains are taken as given

NaN marks missing paths. `rt_params.raytracer_name` says which ray tracer a scenario comes from. Source: documentation
and converters of DeepMIMO 4 (github.com/DeepMIMO/DeepMIMO).
"""

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from dtprob.data.formats import load_arrays
from dtprob.errors import InputError, unknown_name
from dtprob.raytracing.imported import ImportedPaths, path_set, unit_vector
from dtprob.raytracing.paths import PathSet

PARAMETERS: Final = "params.json"
MATRICES: Final = (
    "rx_pos",
    "tx_pos",
    "power",
    "phase",
    "delay",
    "aoa_az",
    "aoa_el",
    "aod_az",
    "aod_el",
)
SIONNA: Final = "Sionna Ray Tracing"
"""The name of the ray tracer whose phases do not hold the delay."""
_PAIR: Final = re.compile(r"power_(t\d+_tx\d+_r\d+)\.(npz|mat)")


def read_scenario(folder: str | os.PathLike[str], pair: str | None = None) -> PathSet:
    """Read the paths between a transmitter and a set of receivers from a scenario's folder.

    Args:
        folder: of the scenario.
        pair: such as "t001_tx000_r000"; may be left out where the folder has one only.

    Raises:
        InputError: no such folder, file or pair, or matrices that do not fit together.
    """
    path = Path(folder)
    if not (path / PARAMETERS).is_file():
        remedy = "Name the folder of a DeepMIMO 4 scenario"
        raise InputError(str(path), f"a folder with {PARAMETERS}", "none", remedy)
    pairs = {found[1]: found[2] for file in path.iterdir() if (found := _PAIR.fullmatch(file.name))}
    chosen = _chosen(path, pairs, pair)
    arrays: dict[str, np.ndarray] = {}
    for key in MATRICES:
        file = path / f"{key}_{chosen}.{pairs[chosen]}"
        arrays[key] = _matrix(file, load_arrays(file), key)
    return from_dictionary({**arrays, "rt_params": _parameters(path / PARAMETERS)})


def from_dictionary(dataset: Mapping[str, Any]) -> PathSet:
    """The path set of a DeepMIMO 4 dataset of one transmitter: `deepmimo.load(...)`, or a dictionary like it.

    Args:
        dataset: the matrices above by name, and `rt_params` with `frequency` in Hz and, where it is `SIONNA`,
            `raytracer_name`.

    Raises:
        InputError: a matrix is missing or has another shape, or there is no path.
    """
    missing = [key for key in (*MATRICES, "rt_params") if key not in dataset]
    if missing:
        got = ", ".join(dataset)
        raise InputError("DeepMIMO dataset", f"a matrix '{missing[0]}'", got, "Load all matrices")
    rx = np.asarray(dataset["rx_pos"], np.float64)
    if rx.ndim != 2 or rx.shape[1] != 3:
        raise InputError("DeepMIMO rx_pos", "shape (receiver, 3)", str(rx.shape), "Transpose it")
    tx = np.asarray(dataset["tx_pos"], np.float64).reshape(-1)
    if tx.shape != (3,):
        remedy = "Take the transmitters of a macro dataset one at a time"
        raise InputError("DeepMIMO tx_pos", "one position, 3 numbers", f"{tx.size} numbers", remedy)
    rows = {key: np.asarray(dataset[key], np.float64) for key in MATRICES[2:]}
    expected = (len(rx), rows["power"].shape[-1])
    for key, value in rows.items():
        if value.shape != expected:
            remedy = "Load all matrices of one scenario"
            raise InputError(
                f"DeepMIMO {key}", f"shape {expected} (receiver, path)", str(value.shape), remedy
            )
    mask = np.all([np.isfinite(value) for value in rows.values()], axis=0)
    rows = {key: np.where(mask, value, 0.0) for key, value in rows.items()}
    frequency = float(np.asarray(dataset["rt_params"]["frequency"]).reshape(-1)[0])
    phase = np.deg2rad(rows["phase"])
    if dataset["rt_params"].get("raytracer_name") == SIONNA:
        phase = phase - 2 * np.pi * np.mod(frequency * rows["delay"], 1.0)
    imported = ImportedPaths(
        coefficient=10 ** (rows["power"] / 20) * np.exp(1j * phase),
        delay=rows["delay"],
        departure=unit_vector(rows["aod_el"], rows["aod_az"]),
        arrival=-unit_vector(rows["aoa_el"], rows["aoa_az"]),
        mask=mask,
        rx_position=rx,
        tx_position=np.broadcast_to(tx, rx.shape),
    )
    return path_set(imported, frequency, (("solver", "DeepMIMO 4"),))


def _chosen(path: Path, pairs: Mapping[str, str], pair: str | None) -> str:
    if pair is None and len(pairs) == 1:
        return next(iter(pairs))
    if pair is None:
        got = ", ".join(sorted(pairs)) or "none"
        remedy = "Choose one with the argument `pair`"
        raise InputError(str(path), "one pair of transmitter and receivers", got, remedy)
    if pair not in pairs:
        raise unknown_name(str(path), pair, pairs, "pair")
    return pair


def _matrix(file: Path, arrays: Mapping[str, np.ndarray], key: str) -> np.ndarray:
    if key not in arrays:
        raise InputError(file.name, f"an array '{key}'", ", ".join(arrays), "Export the scenario again")
    return arrays[key]


def _parameters(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))["rt_params"]
        return {"frequency": float(content["frequency"]), "raytracer_name": content.get("raytracer_name")}
    except (ValueError, KeyError, TypeError) as error:
        expected = "JSON with rt_params.frequency in Hz"
        raise InputError(file.name, expected, str(error), "Export the scenario again") from error
