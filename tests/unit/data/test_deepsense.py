"""The beam sweeps of DeepSense 6G: where they are, what they say, and what files are refused."""

import numpy as np
import pytest

from dtprob.data.deepsense import NAME, SCENARIOS, read_sweeps
from dtprob.data.location import measured_data
from dtprob.errors import InputError


def files(folder, **changes):
    """Three sweeps of scenario 1, the car 0.001 degrees north of the base station, then east of it."""
    station = np.tile([33.0, -112.0], (3, 1))
    arrays = {
        "unit1_pwr_60ghz": 0.5 + np.arange(3 * 64.0).reshape(3, 64),
        "unit1_loc": station,
        "unit2_loc": station + np.array([[0.001, 0], [0, 0.001], [0, 0]]),
        "seq_index": np.array([1, 1, 2]),
    } | changes
    for name, array in arrays.items():
        np.save(folder / f"scenario1_{name}_1-3.npy", array)
    return folder


def test_positions_are_metres_and_noise_is_taken_off(tmp_path):
    sweeps = read_sweeps(1, files(tmp_path))
    # A degree is 111.195 km on a sphere of 6371 km; along a parallel at 33 degrees it is cos 33 of that.
    expected = [[0, 111.195], [111.195 * np.cos(np.radians(33)), 0], [0, 0]]
    np.testing.assert_allclose(sweeps.position, expected, atol=1e-3)
    assert sweeps.power.min() == 0
    assert sweeps.power[2, 63] == 3 * 64 - 1
    np.testing.assert_array_equal(sweeps.sequence, [1, 1, 2])


def test_calibrated_positions_come_first(tmp_path):
    calibrated = np.tile([33.002, -112.0], (3, 1))
    sweeps = read_sweeps(1, files(tmp_path, unit2_loc_cal=calibrated))
    np.testing.assert_allclose(sweeps.position, [[0, 222.39]] * 3, atol=1e-2)


def test_what_does_not_fit_is_refused(tmp_path):
    with pytest.raises(InputError, match="1, 2, 3 or 4"):
        read_sweeps(5, tmp_path)
    with pytest.raises(InputError, match="one file, got 0"):
        read_sweeps(2, tmp_path)
    with pytest.raises(InputError, match="3 sweeps of 64 beams"):
        read_sweeps(1, files(tmp_path, seq_index=np.array([1, 1])))
    with pytest.raises(InputError, match="finite numbers"):
        read_sweeps(1, files(tmp_path, unit2_loc=np.full((3, 2), np.nan)))


@pytest.mark.measured
@pytest.mark.parametrize(
    ("scenario", "count", "passages"), [(1, 2422, 29), (2, 2974, 33), (3, 1487, 52), (4, 1867, 72)]
)
def test_the_measured_scenarios(scenario, count, passages):
    try:
        folder = measured_data(NAME)
    except InputError as error:
        pytest.skip(str(error))
    assert scenario in SCENARIOS
    sweeps = read_sweeps(scenario, folder)
    assert sweeps.power.shape == (count, 64)
    assert len(np.unique(sweeps.sequence)) == passages
    distance = np.linalg.norm(sweeps.position, axis=1)
    assert distance.min() > 5
    assert distance.max() < 60
    # The best beam goes with the direction: along the street, north to south.
    rank = np.corrcoef(np.argsort(np.argsort(sweeps.position[:, 1])), np.argmax(sweeps.power, axis=1))
    assert abs(rank[0, 1]) > 0.75
