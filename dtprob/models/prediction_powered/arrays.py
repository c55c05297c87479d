"""One text of the formulas for NumPy's arrays and JAX's.

A few sums over a million numbers cost less in NumPy than JAX needs to be asked, and nothing has to be compiled
first; gradients of users' losses need JAX. The kind of the arguments decides.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

type Values = Array | np.ndarray
"""An array of either kind."""


def namespace(array: Any) -> Any:
    """`numpy` for a NumPy array or number, else `jax.numpy`."""
    return np if isinstance(array, np.ndarray | np.generic) else jnp


def compiled_for_jax[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """A function that is compiled where any argument holds an array of JAX, and runs as it is on NumPy's.

    On NumPy's arrays it does not warn of overflow: like JAX it returns infinity or NaN.
    """
    compiled = eqx.filter_jit(function)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if any(_is_jax(leaf) for leaf in jax.tree.leaves((args, kwargs))):
            return compiled(*args, **kwargs)
        with np.errstate(all="ignore"):
            return function(*args, **kwargs)

    return call


def _is_jax(leaf: Any) -> bool:
    return type(leaf) is not np.ndarray and isinstance(leaf, jax.Array)  # the first test is the quicker one


def each(function: Callable[[Any], Any], rows: Values) -> Any:
    """A function of one row, applied to every row."""
    if namespace(rows) is jnp:
        return jax.vmap(function)(rows)
    return jax.tree.map(lambda *parts: np.stack(parts), *[function(row) for row in rows])
