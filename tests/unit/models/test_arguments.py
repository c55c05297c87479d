"""Columns of any kind of numbers are arrays; words are refused in one line."""

import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.models.arguments import as_arrays, split_static


class Column:
    """What turns into an array, as a column of a data frame does."""

    def __init__(self, values):
        self.values = np.asarray(values)

    def __array__(self, dtype=None, copy=None):
        return self.values


@pytest.mark.parametrize(
    "column",
    [
        [1.0, 2.5],
        Column([1.0, 2.5]),
        np.array([1.0, 2.5], object),
        np.array([1.0, 2.5]),
        jnp.array([1.0, 2.5]),
    ],
    ids=lambda c: type(c).__name__,
)
def test_numbers_are_arrays(column):
    found = split_static({"y": column})[0]["y"]
    np.testing.assert_array_equal(found, [1.0, 2.5])
    assert found.dtype.kind == "f"


def test_truths_of_any_kind():
    found = as_arrays({"a": [True, False], "b": np.array([True, False], object), "c": Column([True, False])})
    assert {value.dtype for value in found.values()} == {np.dtype(bool)}


def test_settings_stay_what_they_are():
    settings = {
        "kind": "indoor",
        "shape": (3, 2),
        "names": ["a", "b"],
        "ragged": [[1], [1, 2]],
        "none": None,
        "n": 3,
    }
    assert as_arrays(settings) == settings


@pytest.mark.parametrize("words", [np.array(["nokia", "ericsson"]), Column(["nokia", "ericsson"])])
def test_words_are_refused(words):
    with pytest.raises(
        InputError, match=r"data 'vendor': expected numbers, got .nokia. at index 0.*factorize"
    ):
        as_arrays({"vendor": words})


def test_one_word_among_numbers_is_shown():
    with pytest.raises(
        InputError, match=r"data 'level': expected numbers, got 'n/a' at index 1. Write it as a number"
    ):
        as_arrays({"level": np.array(["-91.5", "n/a", "-80.0", "3e1"])})


def test_no_rows_at_all():
    with pytest.raises(InputError, match="at least one value, got none"):
        as_arrays({"level": Column(np.array([], object))})
