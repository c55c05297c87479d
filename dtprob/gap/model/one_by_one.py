"""A traced function of one index after another, as many as are known when the program runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax


def one_by_one[T](function: Callable[[Any], T], count: Any, into: T) -> T:
    """Arrays (n, ...) whose first `count` rows are the values of a function at their indices.

    At once these would not fit in a CPU's cache, and a program for each count would be compiled.

    Args:
        function: of an index, to a pytree of arrays.
        count: of indices, traced.
        into: the arrays (n, ...) of such a pytree, the rows that stay among them.
    """

    def put(i: Any, into: T) -> T:
        return jax.tree.map(lambda every, new: every.at[i].set(new), into, function(i))

    return jax.lax.fori_loop(0, count, put, into)
