"""Measured beam sweeps at 60 GHz with positions, brought to arrays.

Data set: DeepSense 6G, scenarios 1 to 4 (A. Alkhateeb and others, "DeepSense 6G: a large-scale real-world
multi-modal sensing and communication dataset", 2023), in the form of J. Morais and others, "Position-aided beam
prediction in the real world" (2023); CC BY-NC-SA 4.0. A base station at the side of a street sweeps 64 beams
while a car passes; both ends know their positions by satellite.

Powers are in units of the receiver and hold its noise; the least power of a scenario is taken for the noise,
as in the paper. Neighbouring sweeps of one passage are near copies, so data are to be split by passage.
"""

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dtprob.data.location import measured_data
from dtprob.errors import InputError

NAME: Final = "deepsense6g_60ghz"
SCENARIOS: Final = (1, 2, 3, 4)
BEAMS: Final = 64
_EARTH: Final = 6_371_000.0


class Sweeps(NamedTuple):
    """The beam sweeps of one scenario, in the order of measurement.

    Attributes:
        position: of the car, m, east and north of the base station.
        power: that each beam received, its noise taken off, in the receiver's units.
        sequence: which passage a sweep belongs to.
    """

    position: Float[np.ndarray, "sweep 2"]
    power: Float[np.ndarray, "sweep beam"]
    sequence: Int[np.ndarray, " sweep"]


def read_sweeps(scenario: int, folder: Path | None = None) -> Sweeps:
    """One scenario's sweeps; positions are the calibrated ones where the data set has them.

    Args:
        scenario: 1, 2, 3 or 4.
        folder: the data set's folder; by default where `measured_data` finds it.

    Raises:
        InputError: no such scenario, or files that are missing or do not fit together.
    """
    if scenario not in SCENARIOS:
        raise InputError("scenario", "1, 2, 3 or 4", repr(scenario), "Name one of them")
    folder = folder or measured_data(NAME)
    power = _array(folder, scenario, "unit1_pwr_60ghz")
    station = _array(folder, scenario, "unit1_loc")
    calibrated = sorted(folder.glob(f"scenario{scenario}_unit2_loc_cal_*.npy"))
    car = _array(folder, scenario, "unit2_loc_cal" if calibrated else "unit2_loc")
    sequence = _array(folder, scenario, "seq_index")
    count = len(power)
    shapes = [power.shape, station.shape, car.shape, sequence.shape]
    if shapes != [(count, BEAMS), (count, 2), (count, 2), (count,)]:
        expected = f"{count} sweeps of {BEAMS} beams with two positions each"
        got = f"arrays of shapes {shapes}"
        raise InputError(f"scenario {scenario} of {NAME}", expected, got, "Get the files of one version")
    return Sweeps(_east_north(car, station), power - power.min(), sequence.astype(int))


def _array(folder: Path, scenario: int, name: str) -> np.ndarray:
    found = sorted(folder.glob(f"scenario{scenario}_{name}_[0-9]*.npy"))
    if len(found) != 1:
        what = f"scenario{scenario}_{name}_*.npy in {folder}"
        raise InputError(what, "one file", str(len(found)), "Get the data set's files")
    array = np.load(found[0], allow_pickle=False)
    if not np.all(np.isfinite(array)):
        raise InputError(found[0].name, "finite numbers", "NaN or infinity", "Get the file again")
    return array


def _east_north(
    place: Float[np.ndarray, "sweep 2"], origin: Float[np.ndarray, "sweep 2"]
) -> Float[np.ndarray, "sweep 2"]:
    """Metres from the origin for latitudes and longitudes in degrees, on the tangent plane."""
    north, east = np.radians(place - origin).T
    return _EARTH * np.stack([east * np.cos(np.radians(origin[:, 0])), north], axis=1)
