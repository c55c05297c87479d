"""What is written is read back; what is wrong is answered by one line that names it."""

import json
import pickle
import sys

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
import xarray as xr
import zarr

from dtprob.data import ChannelData, Labels, NetworkLog, PowerData, Table, read, read_table, write
from dtprob.errors import InputError


def channel_arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    shape = (3, 4, 2, 1, 5)
    return {
        "channel": rng.normal(size=shape) + 1j * rng.normal(size=shape),
        "subcarrier_frequency": 30e3 * np.arange(-2, 3),
        "snapshot_time": 1e-3 * np.arange(4),
        "rx_position": rng.normal(size=(3, 3)),
        "tx_position": rng.normal(size=(3, 3)),
        "rx_array": np.array([[0, -0.01, 0], [0, 0.01, 0]]),
        "noise_power": np.array([0.1, 0.2, 0.3]),
        "repeat": np.array([0, 0, 1, 1]),
    }


def power_arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(4)
    return {
        "power": rng.uniform(1e-9, 1e-8, (3, 1, 8)),
        "rx_position": rng.normal(size=(3, 3)),
        "tx_position": rng.normal(size=(3, 3)),
    }


def log_columns() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    columns = {"episode": np.repeat([0, 1], 5), "slot": np.tile(np.arange(5), 2)}
    for device in range(2):
        action, arrival = rng.integers(0, 2, (2, 10))
        buffer, ack = np.zeros(10, int), np.zeros(10, int)
        for row in range(10):
            if row % 5:
                buffer[row] = min(buffer[row - 1] + arrival[row - 1] - ack[row - 1], 1)
            ack[row] = action[row] * buffer[row] * rng.integers(0, 2)
        values = {"buffer": buffer, "action": action, "ack": ack, "arrival": arrival}
        columns |= {f"{name}_{device}": value for name, value in values.items()}
    return columns


def save(path, arrays):
    if path.suffix == ".npz":
        np.savez(path, **arrays)
    elif path.suffix in {".h5", ".hdf5", ".nc"}:
        with h5py.File(path, "w") as file:
            for name, array in arrays.items():
                file[name] = array
    elif path.suffix == ".zarr":
        group = zarr.open_group(path, mode="w")
        for name, array in arrays.items():
            group.create_array(name, data=np.asarray(array))
    elif path.suffix == ".mat":
        scipy.io.savemat(path, arrays)
    elif path.suffix == ".csv":
        pd.DataFrame(arrays).to_csv(path, index=False)
    else:
        pd.DataFrame(arrays).to_parquet(path, index=False)
    return path


def assert_same(left, right):
    assert type(left) is type(right)
    assert left.arrays().keys() == right.arrays().keys()
    for name, array in left.arrays().items():
        np.testing.assert_array_equal(array, right.arrays()[name])


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".hdf5", ".nc", ".zarr", ".mat"])
def test_channels_from_every_format(tmp_path, suffix):
    arrays = channel_arrays()
    data = read(save(tmp_path / f"channels{suffix}", arrays))
    assert isinstance(data, ChannelData)
    assert_same(data, ChannelData(**arrays))


def test_matlab_without_trailing_axes_and_with_a_scalar(tmp_path):
    arrays = channel_arrays() | {"noise_power": np.float64(0.5)}
    arrays["channel"] = arrays["channel"][:, :, :1, :, :1]
    arrays["subcarrier_frequency"] = np.zeros(1)
    del arrays["rx_array"]
    expected = ChannelData(**arrays)
    arrays["channel"] = arrays["channel"][:, :, 0, 0, 0]
    data = read(save(tmp_path / "channels.mat", arrays))
    assert_same(data, expected)
    assert data.noise_power.shape == ()


@pytest.mark.parametrize("kind", ["column", "row"])
def test_matlab_columns_are_vectors(tmp_path, kind):
    """A plate over the rows of a 1 x n matrix has one entry, whatever n."""
    columns = log_columns()
    labels = {"x_0": np.arange(3.0), "x_1": np.ones(3), "y": np.array([1.0, np.nan, 2.0])}
    table = {"distance": np.arange(1.0, 4.0), "grid": np.zeros((3, 2))}
    for name, arrays in (("log", columns), ("labels", labels), ("table", table)):
        scipy.io.savemat(tmp_path / f"{name}.mat", arrays, oned_as=kind)
    assert_same(read(tmp_path / "log.mat"), read(save(tmp_path / "log.npz", columns)))
    assert_same(read(tmp_path / "labels.mat"), read(save(tmp_path / "labels.npz", labels)))
    for reader in (read, read_table):
        assert_same(reader(tmp_path / "table.mat"), Table(table))


def test_matlab_7_3_is_read_in_matlab_order(tmp_path):
    arrays = channel_arrays()
    path = tmp_path / "channels.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            stored = np.atleast_2d(array).T if array.ndim < 2 else array.T
            if np.iscomplexobj(stored):
                pair = np.empty(stored.shape, [("real", float), ("imag", float)])
                pair["real"], pair["imag"] = stored.real, stored.imag
                stored = pair
            file[name] = stored
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    header = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    with path.open("r+b") as file:
        file.write(header)
    assert_same(read(path), ChannelData(**arrays))


def test_an_empty_matrix_of_matlab_7_3_has_no_numbers(tmp_path):
    """What the file holds of it is its shape."""
    with h5py.File(tmp_path / "t.h5", "w") as file:
        file["repeat"] = np.array([0, 4], np.uint64)
        file["repeat"].attrs.update({"MATLAB_class": np.bytes_("double"), "MATLAB_empty": np.uint8(1)})
    assert read_table(tmp_path / "t.h5").columns["repeat"].shape == (0, 4)


def test_packed_and_missing_numbers_of_netcdf_are_what_they_stand_for(tmp_path):
    arrays = power_arrays()
    decibels = np.round(10 * np.log10(arrays.pop("power") / 1e-3), 2)
    shapes = {
        "power_db": ("link", "rx", "tx"),
        "rx_position": ("link", "xyz"),
        "tx_position": ("link", "xyz"),
    }
    packed = {"power_db": {"dtype": "int16", "scale_factor": 0.01, "add_offset": -50.0, "_FillValue": -32768}}
    for name, power in (("all", decibels), ("hole", nan_at(decibels, (1, 0, 2), np.nan))):
        given = {n: (shapes[n], a) for n, a in (arrays | {"power_db": power}).items()} | {
            "power_reference": 1e-3
        }
        xr.Dataset(given).to_netcdf(tmp_path / f"{name}.nc", engine="h5netcdf", encoding=packed)
    np.testing.assert_allclose(read(tmp_path / "all.nc").power, 1e-3 * 10 ** (decibels / 10), rtol=1e-9)
    with pytest.raises(InputError, match=r"got NaN at index \(1, 0, 2\)"):
        read(tmp_path / "hole.nc")
    column = xr.Dataset({"level": ("row", [1.0, -9999.0])})
    column["level"].encoding["_FillValue"] = -9999.0
    column.to_netcdf(tmp_path / "column.nc", engine="h5netcdf")
    with pytest.raises(InputError, match="level: expected finite numbers, got NaN at index 1"):
        read(tmp_path / "column.nc")


@pytest.mark.parametrize("suffix", [".npz", ".nc"])
@pytest.mark.parametrize("kind", ["channel", "power"])
def test_written_channels_and_powers_come_back(tmp_path, suffix, kind):
    data = ChannelData(**channel_arrays()) if kind == "channel" else PowerData(**power_arrays())
    write(tmp_path / f"data{suffix}", data)
    assert_same(read(tmp_path / f"data{suffix}"), data)


def test_a_suffix_in_capitals_is_the_same_format(tmp_path):
    """NumPy adds .npz to a name that does not end so: the file of that name was left empty."""
    write(tmp_path / "data.NPZ", PowerData(**power_arrays()))
    assert_same(read(tmp_path / "data.NPZ"), PowerData(**power_arrays()))
    assert [file.name for file in tmp_path.iterdir()] == ["data.NPZ"]


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".parquet"])
def test_written_logs_and_labels_come_back(tmp_path, suffix):
    log = read(save(tmp_path / f"log{suffix}", log_columns()))
    assert isinstance(log, NetworkLog)
    assert log.buffer.shape == (10, 2)
    write(tmp_path / f"again{suffix}", log)
    assert_same(read(tmp_path / f"again{suffix}"), log)
    labels = Labels(
        x=np.arange(8.0).reshape(4, 2),
        y=[1, 2, 0, 0],
        labelled=[1, 1, 0, 0],
        prediction=[1, 2, 3, 4],
        weight=[1, 0.5, 0, 2],
        context=[0, 1, 1, 0],
        cluster=[7, 7, -1, 3],
    )
    write(tmp_path / f"labels{suffix}", labels)
    assert_same(read(tmp_path / f"labels{suffix}"), labels)


def test_power_in_decibels_is_linear_inside(tmp_path):
    arrays = power_arrays()
    decibels = 10 * np.log10(arrays.pop("power") / 1e-3)
    data = read(save(tmp_path / "p.npz", arrays | {"power_db": decibels, "power_reference": 1e-3}))
    assert isinstance(data, PowerData)
    np.testing.assert_allclose(data.power, power_arrays()["power"], rtol=1e-12)


def test_labels_mark_what_is_missing(tmp_path):
    path = save(tmp_path / "labels.csv", {"x": [0.0, 1.0, 2.0], "y": [5.0, np.nan, 7.0]})
    labels = read(path)
    assert isinstance(labels, Labels)
    np.testing.assert_array_equal(labels.labelled, [True, False, True])
    np.testing.assert_array_equal(labels.y, [5.0, 0.0, 7.0])
    assert labels.x.shape == (3, 1)


def test_log_rows_are_sorted(tmp_path):
    frame = pd.DataFrame(log_columns())
    shuffled = frame.sample(frac=1, random_state=0)
    assert_same(
        read(save(tmp_path / "a.csv", dict(shuffled))),
        read(save(tmp_path / "b.csv", dict(frame))),
    )


def test_other_columns_are_a_table(tmp_path):
    path = save(tmp_path / "segments.csv", {"length": [1.0, 2.0], "segment": ["a", "b"]})
    table = read(path)
    assert isinstance(table, Table)
    assert table.columns["segment"].tolist() == ["a", "b"]
    assert read_table(save(tmp_path / "c.npz", channel_arrays())).columns["repeat"].tolist() == [0, 0, 1, 1]


def test_labels_of_other_names_are_told_theirs(tmp_path):
    path = save(tmp_path / "survey.csv", {"distance": [1.0, 2.0], "level": [-80.0, np.nan]})
    with pytest.raises(
        InputError, match=r"level: .*got NaN at index 1.*or if these are labels, name them y and"
    ):
        read(path)


def test_arrays_are_read_only_and_the_given_ones_stay_writable():
    arrays = channel_arrays()
    data = ChannelData(**arrays)
    with pytest.raises(ValueError, match="read-only"):
        data.channel[0] = 0
    arrays["channel"][0] = 0


class Bomb:
    """Leaves a trace when a pickle of it is loaded."""

    def __reduce__(self):
        return (exec, ("raise SystemExit('a pickle was loaded')",))


def test_no_pickle_is_ever_loaded(tmp_path):
    np.savez(tmp_path / "evil.npz", channel=np.array([Bomb()], dtype=object), allow_pickle=True)
    (tmp_path / "plain.npz").write_bytes(pickle.dumps(Bomb()))
    array = tmp_path / "evil.zarr" / "channel"
    array.mkdir(parents=True)
    (tmp_path / "evil.zarr" / ".zgroup").write_text('{"zarr_format": 2}')
    (array / ".zarray").write_text(
        json.dumps(
            {
                "zarr_format": 2, "shape": [1], "chunks": [1], "dtype": "|O", "compressor": None,
                "fill_value": None, "order": "C", "filters": [{"id": "pickle", "protocol": 5}],
            }
        )
    )  # fmt: skip
    (array / "0").write_bytes(pickle.dumps(Bomb()))
    for name in ("evil.npz", "plain.npz", "evil.zarr"):
        with pytest.raises(InputError) as caught:
            read(tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"evil\.npz: expected plain arrays, got Python objects"):
        read(tmp_path / "evil.npz")
    with pytest.raises(InputError, match=r"evil\.zarr: expected plain arrays, got Python objects"):
        read(tmp_path / "evil.zarr")


def nan_at(array: np.ndarray, index: tuple[int, ...], value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


BAD_CHANNELS = {
    "nan": (
        lambda a: {"channel": nan_at(a["channel"], (1, 0, 1, 0, 2), np.nan)},
        r"channel: expected finite numbers, got NaN at index \(1, 0, 1, 0, 2\)",
    ),
    "infinity": (
        lambda a: {"rx_position": nan_at(a["rx_position"], (2, 1), np.inf)},
        r"rx_position: expected finite numbers, got infinity at index \(2, 1\)",
    ),
    "positions of other links": (
        lambda a: {"rx_position": a["rx_position"][:2]},
        r"rx_position: expected shape \(link=3, 3\), got \(2, 3\)",
    ),
    "rank": (
        lambda a: {"channel": a["channel"][0]},
        r"channel: expected shape \(link, snapshot, rx_antenna, tx_antenna, subcarrier\), got \(4, 2, 1, 5\)",
    ),
    "unknown": (
        lambda a: {"rx_positions": a["rx_position"]},
        r"got 'rx_positions'\. Did you mean 'rx_position'\?",
    ),
    "noise zero": (
        lambda a: {"noise_power": np.array([0.1, 0.0, 0.1])},
        "noise_power: expected values above 0, got 0",
    ),
    "noise negative": (
        lambda a: {"noise_power": np.float64(-2)},
        "noise_power: expected values above 0, got -2",
    ),
    "repeat not whole": (lambda a: {"repeat": np.full(4, 0.5)}, "repeat: expected integer numbers"),
    "repeat infinite": (
        lambda a: {"repeat": np.array([0, 0, 1, np.inf])},
        "repeat: expected integer numbers",
    ),
    "repeat length": (
        lambda a: {"repeat": np.zeros(3, int)},
        r"repeat: expected shape \(snapshot=4,\), got \(3,\)",
    ),
    "array of other antennas": (
        lambda a: {"rx_array": np.zeros((3, 3))},
        r"rx_array: expected shape \(rx_antenna=2, 3\), got \(3, 3\)",
    ),
    "no array": (lambda a: {"rx_array": None}, r"rx_array: expected the positions of 2 elements"),
    "no channel": (lambda a: {"channel": None}, "channel: expected an array of shape .* got nothing"),
    "text": (
        lambda a: {"snapshot_time": np.array(["a"] * 4)},
        "snapshot_time: expected real numbers, got 'a' at index 0",
    ),
    "complex positions": (
        lambda a: {"tx_position": a["tx_position"] * 1j},
        "tx_position: expected real numbers",
    ),
    "empty": (lambda a: {"channel": a["channel"][:0]}, "channel: expected at least one link"),
    "amplitudes": (
        lambda a: {"channel": np.abs(a["channel"])},
        r"channel: expected complex coefficients, got real numbers\. Store amplitude and phase",
    ),
    "angles alone": (
        lambda a: {"channel": np.angle(a["channel"]) + 0j},
        r"channel: expected complex coefficients, got real numbers\. Store amplitude and phase",
    ),
    "nothing measured": (lambda a: {"channel": 0 * a["channel"]}, "channel: .* got zeros alone"),
    "words": (
        lambda a: {"channel": np.full(a["channel"].shape, "a")},
        r"channel: expected complex numbers, got 'a' at index \(0, 0, 0, 0, 0\)",
    ),
    "one frequency": (
        lambda a: {"subcarrier_frequency": 0 * a["subcarrier_frequency"] + 5.0},
        r"subcarrier_frequency: expected different frequencies, got [0-9]+ within 0 Hz of 5 Hz",
    ),
    "megahertz": (
        lambda a: {"subcarrier_frequency": np.arange(-2.0, 3.0)},
        r"subcarrier_frequency: expected different frequencies, got 5 within 4 Hz .* in Hz \(not MHz",
    ),
}


@pytest.mark.parametrize("case", BAD_CHANNELS)
def test_bad_channels_are_named(tmp_path, case):
    change, message = BAD_CHANNELS[case]
    arrays = channel_arrays()
    arrays |= change(arrays)
    path = save(tmp_path / "bad.npz", {name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert str(caught.value).startswith("bad.npz: ")
    assert "\n" not in str(caught.value)


BAD_COLUMNS = {
    "missing column": (lambda c: {"ack_1": None}, "ack_1: expected a column, got nothing"),
    "unknown column": (lambda c: {"bufer_0": c["slot"]}, r"got 'bufer_0'\. Did you mean 'buffer_0'\?"),
    "no slot": (lambda c: {"slot": None}, "slot: expected a column"),
    "action": (lambda c: {"action_0": c["slot"]}, r"action_0: expected 0 or 1, got 2 in row 3 "),
    "slot twice": (lambda c: {"slot": c["slot"] * 0}, "slot: expected each slot of an episode once"),
    "negative": (lambda c: {"buffer_0": -1 - c["slot"]}, "buffer: expected values from 0 up, got -5"),
    "infinite slot": (
        lambda c: {"slot": np.where(c["slot"] == 4, np.inf, c["slot"])},
        "slot: expected integer numbers",
    ),
    "fraction": (lambda c: {"buffer_0": c["slot"] / 2}, r"buffer: .*, got 0\.5 at index \(1, 0\)"),
    "empty cell": (
        lambda c: {"buffer_1": np.where(np.arange(len(c["slot"])) == 2, np.nan, c["buffer_1"])},
        r"buffer: expected integer numbers, got NaN at index \(2, 1\)",
    ),
    "word": (
        lambda c: {"action_0": np.where(np.arange(len(c["slot"])) == 1, "no", c["action_0"].astype(str))},
        r"action: expected integer numbers, got 'no' at index \(1, 0\)",
    ),
}


@pytest.mark.parametrize("case", BAD_COLUMNS)
def test_bad_logs_are_named(tmp_path, case):
    change, message = BAD_COLUMNS[case]
    columns = log_columns()
    columns |= change(columns)
    path = save(
        tmp_path / "log.csv", {name: column for name, column in columns.items() if column is not None}
    )
    with pytest.raises(InputError, match=message):
        read(path)


def test_bad_powers_and_labels_are_named(tmp_path):
    arrays = power_arrays()
    with pytest.raises(InputError, match="power_reference: expected a value beside power_db"):
        read(save(tmp_path / "a.npz", {"power_db": arrays["power"], "rx_position": arrays["rx_position"]}))
    dbm = {**arrays, "power": 10 * np.log10(arrays["power"] / 1e-3)}
    with pytest.raises(
        InputError, match=r"power: expected linear values from 0 up, .* as power_db, with power_reference"
    ):
        read(save(tmp_path / "e.npz", dbm))
    levels = {**arrays, "power_db": dbm["power"]}
    del levels["power"]
    for reference in (0.0, -30.0):
        with pytest.raises(
            InputError, match=r"power_reference: expected a positive linear power .* 1e-3 for dBm"
        ):
            read(save(tmp_path / "f.npz", levels | {"power_reference": np.float64(reference)}))
    levels["rssi"] = levels.pop("power_db")
    with pytest.raises(InputError, match=r"array names .* power, power_db, .* got 'rssi'"):
        read(save(tmp_path / "g.npz", levels))
    with pytest.raises(InputError, match="power: expected values from 0 up"):
        PowerData(**(arrays | {"power": -arrays["power"]}))
    with pytest.raises(InputError, match="y: expected at least one label"):
        read(save(tmp_path / "b.npz", {"x": np.zeros(2), "y": np.full(2, np.nan)}))
    with pytest.raises(InputError, match="y: expected real numbers, got yes and no"):
        read(save(tmp_path / "d.npz", {"x": np.zeros(2), "y": np.array([True, False])}))
    with pytest.raises(InputError, match="x: expected finite numbers, got NaN"):
        read(save(tmp_path / "c.npz", {"x": np.array([0, np.nan]), "y": np.zeros(2)}))


def test_the_first_word_among_labels_is_named(tmp_path):
    (tmp_path / "a.csv").write_text("x_0,x_1,y\n0,1,\n0,low,1\n")
    with pytest.raises(InputError, match=r"x: expected real numbers, got 'low' at index \(1, 1\)"):
        read(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text("x_0,y\n0,\n1,2;5\n")
    with pytest.raises(InputError, match="y: expected real numbers, got '2;5' at index 1"):
        read(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text("x_0,y\n")
    with pytest.raises(InputError, match="expected a row for each reading, got a header alone"):
        read(tmp_path / "a.csv")


def test_arrays_within_a_group_are_not_overlooked(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_group("campaign")["channel"] = np.ones(3)
    with pytest.raises(InputError, match=r"got the group 'campaign' alone\. Write the arrays at the top"):
        read(tmp_path / "a.h5")


def test_features_of_other_lengths_are_named(tmp_path):
    file = save(tmp_path / "a.npz", {"x_0": np.zeros(3), "x_1": np.zeros(4), "y": np.zeros(3)})
    with pytest.raises(InputError, match=r"x_1: expected 3 values in a row, as x_0 has, got shape \(4,\)"):
        read(file)


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_words_stay_whole_beside_an_empty_cell(tmp_path, ending):
    frame = pd.DataFrame({"site": ["site_1", None, "site_23"], "y": [1.0, 2.0, 3.0]})
    file = tmp_path / f"a.{ending}"
    frame.to_csv(file, index=False) if ending == "csv" else frame.to_parquet(file)
    assert read_table(file).arrays()["site"].tolist() == ["site_1", "", "site_23"]


def test_bad_files_are_named(tmp_path):
    with pytest.raises(InputError, match="expected a data file, got no such file"):
        read(tmp_path / "none.npz")
    (tmp_path / "a.pkl").write_bytes(b"")
    with pytest.raises(InputError, match=r"got the suffix '\.pkl'"):
        read(tmp_path / "a.pkl")
    for name in ("broken.h5", "broken.mat", "broken.parquet", "broken.npz"):
        (tmp_path / name).write_bytes(b"\x00\x01 not what the suffix says")
        with pytest.raises(InputError) as caught:
            read(tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"expected the suffix \.npz or \.nc"):
        write(tmp_path / "a.csv", PowerData(**power_arrays()))


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("x,y,x\n1,2,3\n", "columns of different names, got 'x' twice"),
        ("x;y\n1;2\n", "columns that commas separate"),
        ("x\ty\n1\t2\n", "columns that commas separate"),
        ("x,y\n1,5,-90,25\n", "got 4 cells in the first row, 2 names. .* points in numbers"),
        ("", "expected a header and a row for each reading, got no text"),
        (b"x,naive\n1,\xef\n", r"expected a table in UTF-8, got another encoding \(byte 10\)"),
        (b"x,y\n" + 9999 * b"1,2\n" + b"\xe9,2\n", "expected a table in UTF-8, got another encoding"),
        ("x,y\n1,2\n".encode("utf-16"), r"expected a table in UTF-8, .* Save it as UTF-8"),
    ],
)
def test_tables_that_would_be_misread_are_refused(tmp_path, text, what):
    path = tmp_path / "table.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=what):
        read_table(path)


def test_blanks_around_names_and_a_trailing_comma_are_forgiven(tmp_path):
    (tmp_path / "t.csv").write_text(" distance , level,\n1.0,2.0,\n3.0,4.0,\n")
    found = read_table(tmp_path / "t.csv").columns
    assert {name: column.tolist() for name, column in found.items()} == {
        "distance": [1.0, 3.0],
        "level": [2.0, 4.0],
    }


def test_names_that_pandas_takes_for_nothing_are_names(tmp_path):
    (tmp_path / "t.csv").write_text("NA,None,null\n1,2,3\n4,5,6\n")
    assert list(read_table(tmp_path / "t.csv").columns) == ["NA", "None", "null"]


def test_words_that_pandas_takes_for_nothing_are_words(tmp_path):
    """Beside other words NA is a region and None a class; in a column of numbers they are missing."""
    (tmp_path / "t.csv").write_text("region,blocked_by\nNA,None\nEU,wall\n,null\n")
    found = read_table(tmp_path / "t.csv").columns
    assert found["region"].tolist() == ["NA", "EU", ""]
    assert found["blocked_by"].tolist() == ["None", "wall", "null"]
    (tmp_path / "labels.csv").write_text("x,y\n0,1.5\n1,NA\n2,\n")
    assert read(tmp_path / "labels.csv").labelled.tolist() == [True, False, False]


def test_rows_that_end_in_a_comma_do_not_shift_columns(tmp_path):
    (tmp_path / "t.csv").write_text("a,b\n1,2,\n3,4,\n")
    found = read_table(tmp_path / "t.csv").columns
    assert {name: column.tolist() for name, column in found.items()} == {"a": [1, 3], "b": [2, 4]}
    (tmp_path / "t.csv").write_text("a,b\n1,2,3\n4,5,6\n")
    with pytest.raises(InputError, match="a name for each column, got 3 cells in the first row, 2 names"):
        read_table(tmp_path / "t.csv")


def test_a_later_row_with_more_cells_is_refused(tmp_path):
    """A decimal comma shifts what follows; pandas drops the last cell without a word."""
    path = tmp_path / "t.csv"
    path.write_text("d,p\n1.5,-60.1\n2,5,-61\n")
    with pytest.raises(
        InputError, match=r"t\.csv, line 3: expected 2 cells as in the first line, got 3\. Write points"
    ):
        read_table(path)
    path.write_text('d,p\n1.5,-60.1,\n"2.5",-61\n\n')
    assert read_table(path).columns["p"].tolist() == [-60.1, -61.0]


HOURS = np.datetime64("2024-01-01") + np.arange(6) * np.timedelta64(1, "h")


@pytest.mark.parametrize("engine", ["h5netcdf", "scipy"])
def test_times_are_seconds_whatever_unit_they_were_stored_in(tmp_path, engine):
    table = xr.Dataset(
        {"time": ("row", HOURS), "level": ("row", np.arange(6.0)), "name": ("row", list("abcdef"))}
    )
    for units, origin in (("hours since 2024-01-01", 0.0), ("minutes since 2023-12-31", 86400.0)):
        table.to_netcdf(tmp_path / "t.nc", engine=engine, encoding={"time": {"units": units}})
        found = read_table(tmp_path / "t.nc").columns
        np.testing.assert_array_equal(found["time"], origin + 3600.0 * np.arange(6))
        np.testing.assert_array_equal(found["level"], np.arange(6.0))
        assert found["name"].tolist() == list("abcdef")


@pytest.mark.parametrize("kind", ["i2", "i4", "i8", "f4"])
def test_times_of_any_width_are_seconds(tmp_path, kind):
    days = np.array([17000, 17001], kind)
    for units, seconds in (("days since 1970-01-01", 86400.0), ("resets since 2020", 1), ("m since 2020", 1)):
        with h5py.File(tmp_path / "t.nc", "w") as file:
            file["time"] = days
            file["time"].attrs["units"] = units
        np.testing.assert_array_equal(
            read_table(tmp_path / "t.nc").columns["time"], seconds * days.astype(float)
        )


def test_a_unit_without_a_length_is_refused(tmp_path):
    with h5py.File(tmp_path / "t.nc", "w") as file:
        file["time"] = np.arange(3.0)
        file["time"].attrs["units"] = "months since 2024-01-01"
    with pytest.raises(InputError, match=r"got months since a date\. Write times as seconds"):
        read_table(tmp_path / "t.nc")


@pytest.mark.parametrize("engine", ["h5netcdf", "scipy"])
def test_powers_may_have_coordinates_of_their_dimensions(tmp_path, engine):
    arrays = power_arrays()
    axes = {
        "power": ("link", "snapshot", "subcarrier"),
        "rx_position": ("link", "xyz"),
        "tx_position": ("link", "xyz"),
    }
    coords = {"link": np.arange(3), "snapshot": [0.0], "xyz": list("xyz")}
    whole = xr.Dataset({name: (axes[name], value) for name, value in arrays.items()}, coords)
    whole.to_netcdf(tmp_path / "p.nc", engine=engine)
    found = read(tmp_path / "p.nc")
    assert isinstance(found, PowerData)
    np.testing.assert_array_equal(found.power, arrays["power"])


def test_a_table_takes_no_options(tmp_path):
    (tmp_path / "t.csv").write_text("a,b\n1,2\n3,4\n")
    with pytest.raises(InputError, match=r"options of t.csv: expected none, got separator"):
        read_table(tmp_path / "t.csv", {"separator": ";"})


@pytest.mark.parametrize(
    ("name", "told"), [("a.ZARR", "pip install zarr"), ("a.parquet", "Install dtprob again")]
)
def test_a_package_that_is_not_installed_is_named(tmp_path, monkeypatch, name, told):
    (tmp_path / name).mkdir()
    for package in ("zarr", "pyarrow.parquet"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"a format that can be read here, got import of .*{told}"):
        read_table(tmp_path / name)
