"""Whole numbers in data that point into a model's arrays, as a site's number into the levels of sites."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

import equinox as eqx
import jax
import numpy as np
from jax.experimental import checkify

from dtprob.errors import InputError
from dtprob.models.arguments import Data, Model, model_name, split_static
from dtprob.models.declaration import trace_model

_SAID: Final = re.compile(r"index (-?\d+) is out of bounds for axis \d+ with size (\d+)")


def check_indices(model: Model, data: Data, where: str = "data") -> None:
    """Run the model once and look at every index: beyond an array's end JAX takes the last entry without a word.

    Args:
        model: a NumPyro model.
        data: its arguments by name; without columns of whole numbers nothing is looked at.
        where: what to call them in an error.

    Raises:
        InputError: an index is beyond the end of an array.
    """
    arrays, static = split_static(data)
    whole = {name: np.asarray(column) for name, column in arrays.items() if _is_of_whole_numbers(column)}
    if not whole:
        return

    def run(
        arrays: Mapping[str, Any], key: jax.Array
    ) -> None:  # of which nothing but the indices is compiled
        trace_model(model, eqx.combine(arrays, static), key)

    checked = checkify.checkify(run, errors=checkify.index_checks)
    found, _ = jax.jit(checked)(arrays, jax.random.key(0))
    said = _SAID.search(found.get() or "")
    if said is None:
        return
    index, size = map(int, said.groups())
    beyond = {name: column for name, column in whole.items() if column.max() >= size and index in column}
    name, column = next(iter(beyond.items()), ("", np.array(index)))
    raise InputError(
        f"{where} {name!r}" if beyond else f"model {model_name(model)}",
        f"indices from 0 to {size - 1} of an array of {size}",
        f"{column.max()}",
        "Number from 0 and give the array, or its plate, as many entries; where it is meant, use jnp.clip",
    )


def _is_of_whole_numbers(column: Any) -> bool:
    return (
        eqx.is_array_like(column)
        and np.ndim(column) > 0
        and np.size(column) > 0
        and column.dtype.kind in "iu"
    )
