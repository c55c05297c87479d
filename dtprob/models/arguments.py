"""The arguments that a model is given: columns of numbers, and settings."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Any, Final, cast

import equinox as eqx
import jax
import numpy as np

from dtprob.data.arrays import is_number
from dtprob.errors import InputError, nearest

type Data = Mapping[str, Any]
type Model = Callable[..., Any]

_ARRAYS: Final = (jax.Array, np.ndarray, np.generic)
_NUMBERS: Final = "biufc"
"""Kinds of dtypes."""


def model_name(function: Model) -> str:
    """The model's name in reports and files."""
    function = whole(function)
    return getattr(function, "__name__", type(function).__name__)


def whole(function: Model) -> Model:
    """The function of which a partial one holds some arguments; it has the name and the metadata."""
    while isinstance(function, functools.partial):
        function = function.func
    return function


def within(model: Model, handler: Callable[[], AbstractContextManager[Any]]) -> Model:
    """The model, of the same arguments, each run of it under a handler of its own."""

    @functools.wraps(whole(model))
    def run(*args: Any, **given: Any) -> Any:
        with handler():
            return model(*args, **given)

    run.__signature__ = inspect.signature(model)  # pyright: ignore[reportAttributeAccessIssue]
    return run


def taking(model: Model, data: Data, column: str | None) -> Model:
    """The model, which also takes a column of the data and leaves it alone, as the one whose values name clusters."""
    signature = inspect.signature(model)
    taken = signature.parameters.values()
    if column is None or column not in data or column in signature.parameters:
        return model
    if any(p.kind is p.VAR_KEYWORD for p in taken):
        return model

    @functools.wraps(whole(model))
    def run(*args: Any, **given: Any) -> Any:
        return model(*args, **{name: value for name, value in given.items() if name != column})

    more = inspect.Parameter(column, inspect.Parameter.KEYWORD_ONLY, default=None)
    run.__signature__ = signature.replace(parameters=[*taken, more])  # pyright: ignore[reportAttributeAccessIssue]
    return run


def as_arrays(data: Data) -> dict[str, Any]:
    """Data whose columns are arrays: lists of numbers and what turns into an array, as columns of pandas, are converted.

    Within dictionaries lists are left alone, which may be settings.

    Raises:
        InputError: a column holds text or other objects.
    """
    return {name: _column(name, entry) for name, entry in dict(data).items()}


def _within(name: str, entry: Any) -> Any:
    """What a dictionary among the data holds, columns of pandas as arrays."""
    if isinstance(entry, dict):
        return {key: _within(f"{name}[{key!r}]", value) for key, value in entry.items()}
    return _column(name, entry) if hasattr(entry, "__array__") else entry


def doubled(data: Data) -> dict[str, Any]:
    """Data whose real and complex arrays are in double precision; call it where that is enabled."""

    def wider(leaf: Any) -> Any:
        if not isinstance(leaf, _ARRAYS) or not jax.numpy.issubdtype(leaf.dtype, jax.numpy.inexact):
            return leaf
        return leaf.astype(complex if jax.numpy.issubdtype(leaf.dtype, jax.numpy.complexfloating) else float)

    return {name: jax.tree.map(wider, entry) for name, entry in data.items()}


def _column(name: str, entry: Any) -> Any:
    is_array, is_column = isinstance(entry, _ARRAYS), hasattr(entry, "__array__")
    if isinstance(entry, jax.Array) or (
        isinstance(entry, np.ndarray | np.generic) and entry.dtype.kind in _NUMBERS
    ):
        return entry
    if isinstance(entry, dict):
        return _within(name, entry)
    if not (is_column or isinstance(entry, list)):
        return entry
    try:
        array = np.asarray(np.asarray(entry).tolist())  # objects may be numbers all the same
    except ValueError:  # lists of unequal lengths
        return entry
    if array.dtype.kind in _NUMBERS and array.size:
        return array
    if not (is_array or is_column):
        return entry  # a list of words is a setting
    if not array.size:
        raise InputError(f"data {name!r}", "at least one value", "none", "Give a row for each reading.")
    odd = [k for k, value in enumerate(array.reshape(-1)) if not is_number(value)]
    got = f"{str(array.reshape(-1)[odd[0]])!r} at index {odd[0]}" if odd else "numbers as text"
    words = "Give each word a whole number (the first of pandas.factorize), each time seconds, or leave the column out."
    repair = "Write it as a number, or mask the reading."
    raise InputError(f"data {name!r}", "numbers", got, words if 2 * len(odd) > array.size else repair)


def select_arguments(function: Model, data: Data) -> dict[str, Any]:
    """The entries of `data` that the model takes, checked against its signature.

    Raises:
        InputError: a required argument is missing, or the data has an entry that the model does not take.
    """
    parameters = inspect.signature(function).parameters
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    for name in data:
        if name not in parameters and not takes_any:
            hint = nearest(name, parameters)
            raise InputError(
                f"data for {model_name(function)}",
                f"arguments among {', '.join(parameters)}",
                repr(name),
                f"Did you mean {hint!r}?" if hint else "Remove it, or add the argument to the model.",
            )
    for name in lacking(function, data):
        raise InputError(
            f"data for {model_name(function)}",
            f"an entry {name!r}",
            ", ".join(data) or "nothing",
            f"Give {name!r}, or a default in the model.",
        )
    return as_arrays(data)


def lacking(function: Model, data: Data) -> list[str]:
    """Arguments that a model cannot do without and the data do not hold."""
    return [
        name
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
        and parameter.default is parameter.empty
        and name not in data
    ]


def left_out(function: Model, data: Data) -> list[str]:
    """Arguments that are None, given or by default, as observations are that nobody made."""
    parameters = inspect.signature(function).parameters
    return [name for name, one in parameters.items() if data.get(name, one.default) is None]


def split_static(data: Data) -> tuple[dict[str, Any], dict[str, Any]]:
    """Data as (arrays, everything else), so that arrays can be arguments of compiled functions.

    Plain numbers are settings: a model may size a plate by them.
    """
    arrays, static = eqx.partition(as_arrays(data), lambda entry: isinstance(entry, _ARRAYS))
    return cast("dict[str, Any]", arrays), cast("dict[str, Any]", static)
