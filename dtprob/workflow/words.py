"""Columns of words in a table of the user's own: each word is a number, its place in a list of the CASE."""

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from dtprob.data.arrays import is_number
from dtprob.errors import InputError, nearest, unknown_name
from dtprob.sections import Words

_MOST: Final = 24
"""Different words up to which a column is told as a list that the CASE could have."""
_TIME: Final = re.compile(r"\d+[-/:]\d")
"""How a date or a time of day begins."""
_PLACED: Final = (("where", "sites"), ("unlisted", "located"), ("remainder", "terms"))
"""Where a report tells of places."""
_KEYS: Final = ("place", "family", "whereabouts", "shape", "summary")


def coded(file: Path, columns: Mapping[str, Any], words: Words, taken: Collection[str]) -> dict[str, Any]:
    """The columns of a table with whole numbers for words.

    Args:
        file: the table.
        columns: by name.
        words: of the columns that hold words.
        taken: names of the columns that the model takes; words in others stay as they are.

    Raises:
        InputError: a word that its list does not have, a list for a column that holds numbers, or a column of words that
            the model takes and no list is for.
    """
    result = dict(columns)
    for name, column in columns.items():
        text = np.asarray(column)
        is_text = text.dtype.kind == "U"
        if name in words:
            if not is_text:
                remedy = f"Leave {name} out of [data.words]"
                raise InputError(f"{file.name}, column {name!r}", "words", "numbers", remedy)
            result[name] = _numbers(file, name, text, words[name])
        elif is_text and name in taken and _has_commas(text):
            remedy = "Write points in numbers, and leave out what separates thousands"
            raise InputError(
                f"{file.name}, column {name!r}", "numbers", f"words ({str(text.flat[0])!r} first)", remedy
            )
        elif is_text and name in taken and _are_names(text):
            found = sorted(set(text.reshape(-1).tolist()))
            listed = ", ".join(f'"{word}"' for word in found)
            remedy = f"Number its words in the CASE: [data.words] {name} = [{listed}]"
            raise InputError(
                f"{file.name}, column {name!r}", "numbers", f"words ({str(text.flat[0])!r} first)", remedy
            )
    return result


def check_words(where: str, words: Words, columns: Collection[str]) -> None:
    """Refuse lists of words for columns that are not there, and lists that have a word twice.

    Args:
        where: what to call the lists in an error.
        words: of columns.
        columns: names of those that the table has.

    Raises:
        InputError: such a list.
    """
    for name, listed in words.items():
        if name not in columns:
            raise unknown_name(where, name, columns, "column")
        twice = [word for word in listed if listed.count(word) > 1]
        if twice:
            raise InputError(
                f"{where} {name}", "words that differ", f"{twice[0]!r} twice", "Leave one of them out"
            )


def spelled(report: Mapping[str, Any], words: Words) -> dict[str, Any]:
    """A diagnosis' report whose places are called by their words: `site harbour` for `site 0`.

    Args:
        report: its content.
        words: of the table's columns.
    """
    result = dict(report)
    for part, name in _PLACED:
        section = result.get(part) or {}
        if name in section:
            result[part] = {**section, name: [_with_words(entry, words) for entry in section[name]]}
    return _with_words(result, words)


def _numbers(file: Path, name: str, text: np.ndarray, listed: Sequence[str]) -> np.ndarray:
    number = {word: k for k, word in enumerate(listed)}
    every = text.reshape(-1).tolist()
    for place, word in zip(np.ndindex(np.atleast_1d(text).shape), every, strict=True):
        if word not in number:
            row = ", ".join(map(str, place))
            close = nearest(word, listed)
            remedy = (
                f"Did you mean {close!r}?" if close else f"Correct it, or add it to {name} in [data.words]"
            )
            expected = f"one of {', '.join(listed)}"
            raise InputError(f"{file.name}, column {name!r}, row {row}", expected, repr(word), remedy)
    return np.reshape([number[word] for word in every], text.shape)


def _has_commas(text: np.ndarray) -> bool:
    """Whether all words are numbers but for commas in them."""
    words = set(text.reshape(-1).tolist())
    return all(is_number(word.replace(",", "")) for word in words) and any("," in word for word in words)


def _are_names(text: np.ndarray) -> bool:
    """Whether words are so few that a list of them is what is wanted, and neither numbers nor points in time."""
    found = set(text.reshape(-1).tolist())
    is_name = (word and not is_number(word) and not _TIME.match(word) for word in found)
    return text.ndim > 0 and 0 < len(found) <= _MOST and all(is_name)


def _with_words(entry: Mapping[str, Any], words: Words) -> dict[str, Any]:
    return {key: _spelled(said, words) if key in _KEYS and said else said for key, said in entry.items()}


def _spelled(text: str, words: Words) -> str:
    """The text with words for single numbers of their columns; an axis of the same name may be longer than the list."""
    for name, listed in words.items():
        number = {f"{name} {k}": f"{name} {word}" for k, word in enumerate(listed)}
        pattern = rf"(?<!\w){re.escape(name)} \d+(?!\w|\.\d| to)"
        text = re.sub(pattern, lambda found, number=number: number.get(found[0], found[0]), text)
    return text
