"""Whole numbers in data that point into a model's arrays, as a site's number into the levels of sites."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import checkify

from dtprob.errors import InputError
from dtprob.models.arguments import Data, Model, select_arguments, split_static
from dtprob.models.execution import NOT_TRACED, trace_model

_SAID: Final = re.compile(r"index (-?\d+) is out of bounds for axis \d+ with size (\d+)")


def check_indices(model: Model, data: Data, where: str = "data") -> None:
    """Run the model once and look at indices such as `level[site]`: beyond the end JAX takes the last entry without a word.

    What happens there is said by `jnp.take`, `.at[].get(mode=...)` and sums by segments, which are left alone.

    Args:
        model: a NumPyro model.
        data: its arguments by name; without columns of whole numbers nothing is looked at.
        where: what to call them in an error.

    Raises:
        InputError: an index of a column is beyond the end of an array, or the data do not match the model's arguments.
    """
    arrays, static = split_static(select_arguments(model, data))
    whole = {name: np.asarray(column) for name, column in arrays.items() if _is_of_whole_numbers(column)}
    if not whole:
        return

    def run(arrays: Mapping[str, Any], key: jax.Array) -> None:
        """Of which nothing but the indices is compiled."""
        trace_model(model, eqx.combine(arrays, static), key)

    key = jax.random.key(0)
    try:
        sizes = _looked_up(jax.make_jaxpr(run)(arrays, key).jaxpr)
    except (*NOT_TRACED, NotImplementedError):
        return  # which `declare` tells
    if all(_is_within(column, size) for column in whole.values() for size in sizes):
        return  # without compiling anything
    checked = jax.jit(checkify.checkify(run, errors=checkify.index_checks))

    def says(arrays: Mapping[str, Any]) -> re.Match[str] | None:
        return _SAID.search(checked(arrays, key)[0].get() or "")

    said = says(arrays)
    if said is None:
        return
    index, size = map(int, said.groups())
    beyond = {
        n: c for n, c in whole.items() if np.isin(c, (index, index - size)).any() and not _is_within(c, size)
    }
    if size in sizes and beyond:
        # of several columns that hold the number, the one without which nothing points there
        cut = {n: {**arrays, n: jnp.clip(arrays[n], -size, size - 1)} for n in beyond}
        after = {n: says(without) for n, without in cut.items()} if len(beyond) > 1 else {}
        name = next(
            (n for n, still in after.items() if still is None or still[0] != said[0]), next(iter(beyond))
        )
        column = beyond[name]
        raise InputError(
            f"{where} {name!r}",
            f"indices from 0 to {size - 1} of an array of {size}",
            f"{column.max() if column.max() >= size else column.min()}",
            "Number from 0 and give the array, or its plate, as many entries; where it is meant, use jnp.clip",
        )


def _looked_up(jaxpr: Any) -> set[int]:
    """Sizes of the axes into which plain indices point, as those of `x[i]`, anywhere in a program."""
    found: set[int] = set()
    for equation in jaxpr.eqns:
        given = equation.params
        if (
            equation.primitive.name == "gather"
            and given["mode"] == jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
        ):
            shape = equation.invars[0].aval.shape
            found |= {shape[axis] for axis in given["dimension_numbers"].start_index_map}
        for inner in jax.tree.leaves(list(given.values()), is_leaf=_is_program):
            if _is_program(inner):
                found |= _looked_up(getattr(inner, "jaxpr", inner))
    return found


def _is_program(value: Any) -> bool:
    return hasattr(value, "eqns") or hasattr(value, "jaxpr")


def _is_within(column: np.ndarray, size: int) -> bool:
    return bool(column.min() >= -size and column.max() < size)


def _is_of_whole_numbers(column: Any) -> bool:
    return (
        eqx.is_array_like(column)
        and np.ndim(column) > 0
        and np.size(column) > 0
        and column.dtype.kind in "iu"
    )
