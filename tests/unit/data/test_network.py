"""Network logs: what is wrong with a row is said, with the row."""

import numpy as np
import pandas as pd
import pytest

from dtprob.data import read
from dtprob.data.write import file_arrays
from dtprob.errors import InputError
from tests.small_network import simulate


@pytest.fixture
def columns():
    return pd.DataFrame(file_arrays(simulate(12, 3, episodes=2)))


def changed(columns, row, **values):
    columns = columns.copy()
    for name, value in values.items():
        columns.loc[row, name] = value
    return columns


def first(columns, **values):
    """The first row at which columns have given values."""
    return int(np.flatnonzero(np.all([columns[name] == value for name, value in values.items()], axis=0))[0])


def saved(tmp_path, columns):
    columns.to_csv(tmp_path / "log.csv", index=False)
    return tmp_path / "log.csv"


def test_a_sound_log(tmp_path, columns):
    log = read(saved(tmp_path, columns))
    assert log.buffer.shape == (24, 4)


def test_a_missing_slot_is_named_and_can_split_the_episode(tmp_path, columns):
    path = saved(tmp_path, columns.drop(index=5))
    with pytest.raises(
        InputError, match=r"slot: expected slot 5 of episode 0, got row 6 \(episode 0, slot 6\)"
    ):
        read(path)
    log = read(path, {"allow_gaps": True})
    assert np.array_equal(np.unique(log.episode, return_counts=True)[1], [5, 6, 12])


def test_an_empty_episode_is_named(tmp_path, columns):
    columns["episode"] *= 2
    with pytest.raises(InputError, match=r"episode: expected a slot or more of episode 1, got none"):
        read(saved(tmp_path, columns))
    assert len(np.unique(read(saved(tmp_path, columns), {"allow_gaps": True}).episode)) == 2


def test_a_delivery_without_sending_is_named(tmp_path, columns):
    row = first(columns, action_2=0)
    message = rf"ack_2: expected 0 where the action is 0, got 1 in row {row + 1} \(episode 0, slot {row}\)"
    with pytest.raises(InputError, match=message):
        read(saved(tmp_path, changed(columns, row, ack_2=1)))


def test_a_delivery_from_an_empty_buffer_is_named(tmp_path, columns):
    message = r"ack_1: expected 0 where the buffer is 0, got 1 in row 1 "
    with pytest.raises(InputError, match=message):
        read(saved(tmp_path, changed(columns, 0, action_1=1, ack_1=1)))


def test_a_buffer_that_cannot_follow_is_named(tmp_path, columns):
    row = first(columns, arrival_3=0, buffer_3=0)
    message = rf"buffer_3: expected 0 after the slot before, got 1 in row {row + 2} "
    with pytest.raises(InputError, match=message):
        read(saved(tmp_path, changed(columns, row + 1, buffer_3=1, ack_3=0)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.assign(buffer_9=0), "buffer_4: expected a column, got nothing"),
        (lambda c: c.iloc[:0], "expected a row for each reading, got a header alone"),
        (lambda c: changed(c, 3, action_0=2), r"action_0: expected 0 or 1, got 2 in row 4 "),
    ],
)
def test_other_faults(tmp_path, columns, change, message):
    with pytest.raises(InputError, match=message):
        read(saved(tmp_path, change(columns)))


def test_a_log_without_rows_is_named(tmp_path, columns):
    columns.iloc[:0].to_parquet(tmp_path / "log.parquet")
    with pytest.raises(InputError, match="expected at least one row, got an empty table"):
        read(tmp_path / "log.parquet")


def test_values_and_places_are_of_one_row_where_the_file_is_not_sorted(tmp_path):
    rows = [(1, 0, 0), (1, 1, 7), (0, 0, 0), (0, 1, 3)]
    columns = pd.DataFrame(rows, columns=["episode", "slot", "buffer_0"]).assign(
        action_0=0, ack_0=0, arrival_0=0
    )
    message = r"buffer_0: expected 0 after the slot before, got 7 in row 2 \(episode 1, slot 1\)"
    with pytest.raises(InputError, match=message):
        read(saved(tmp_path, columns))
    twice = columns.assign(buffer_0=0, slot=[5, 5, 0, 0])
    with pytest.raises(
        InputError, match=r"got slot 5 of episode 1 twice, again in row 2 \(episode 1, slot 5\)"
    ):
        read(saved(tmp_path, twice))


@pytest.mark.parametrize("slot", [["a", "b"], [0.0, np.nan], [0.0, 0.5]])
def test_slots_that_are_no_numbers_split_no_episode(tmp_path, slot):
    columns = pd.DataFrame({"episode": [0, 0], "slot": slot}).assign(
        buffer_0=0, action_0=0, ack_0=0, arrival_0=0
    )
    with pytest.raises(InputError, match="slot: expected integer numbers"):
        read(saved(tmp_path, columns), {"allow_gaps": True})


def test_columns_of_other_lengths_are_named(tmp_path, columns):
    arrays = {name: columns[name].to_numpy() for name in columns}
    np.savez(tmp_path / "log.npz", **{**arrays, "buffer_1": arrays["buffer_1"][:20]})
    with pytest.raises(
        InputError, match=r"buffer_1: expected 24 values in a row, as buffer_0 has, got shape \(20,\)"
    ):
        read(tmp_path / "log.npz")


def test_an_unknown_option_is_named(tmp_path, columns):
    with pytest.raises(InputError, match="Did you mean 'allow_gaps'"):
        read(saved(tmp_path, columns), {"alow_gaps": True})
