"""Observed values that a model's distributions cannot take, to which NumPyro gives a density all the same.

Where a support ends may be unknown: a uniform delay's largest value, the shift of an exponential one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro

from dtprob.errors import InputError
from dtprob.models.arguments import Data, Model, select_arguments, split_static
from dtprob.models.declaration import base_constraint
from dtprob.models.execution import NOT_TRACED, trace_model
from dtprob.wrapping import unwrapped

_DRAWS: Final = 8
"""Draws from the prior of which one has to allow a value: where a support ends may be unknown."""
_ANY: Final = ("Real", "Complex", "Circular", "Sphere", "Simplex")
"""Supports of which no value is refused: all numbers, angles counted from anywhere, and what sums to 1 but for rounding."""


def check_support(model: Model, data: Data, where: str = "data", own: Sequence[str] = ()) -> None:
    """Run the model at draws from its prior, and look whether its observed distributions can take the values of the data.

    Args:
        model: a NumPyro model.
        data: its arguments by name.
        where: what to call them in an error.
        own: arguments that hold those of many data sets, stacked on a leading axis.

    Raises:
        InputError: a value that counts is outside the support of its distribution at each draw, beyond an end that
            does not move from draw to draw.
    """
    arrays, static = split_static(select_arguments(model, data))

    families: dict[str, str] = {}

    def one(arrays: Mapping[str, Any], key: jax.Array) -> dict[str, tuple[jax.Array, ...]]:
        """Values, which are allowed, and where the support ends."""
        trace = trace_model(model, eqx.combine(arrays, static), key)
        seen = {n: site for n, site in trace.items() if site["type"] == "sample" and site["is_observed"]}
        bounded = {n: site for n, site in seen.items() if _ends(site["fn"].support) is not None}
        families.update({n: type(unwrapped(site["fn"])[0]).__name__ for n, site in bounded.items()})
        values = {n: jnp.asarray(site["value"]) for n, site in bounded.items()}
        return {
            n: (value, _allows(bounded[n]["fn"], value), *_limits(bounded[n])) for n, value in values.items()
        }

    keys = jax.random.split(jax.random.key(0), _DRAWS)
    axes = {name: 0 if name in own else None for name in arrays}
    with numpyro.validation_enabled(is_validate=False):  # which makes densities at the ends infinite
        try:
            if not jax.eval_shape(_each(one, axes), arrays, keys[0]):
                return
        except (*NOT_TRACED, NotImplementedError):
            return  # which `declare` tells
        looked = jax.jit(lambda arrays, keys: jax.lax.map(lambda key: _each(one, axes)(arrays, key), keys))
        found = looked(arrays, keys)
    for name, family in families.items():  # the first of the model is named
        values, allowed, low, high = (np.asarray(part) for part in found[name])
        refused = ~(allowed | _beyond_moving(values, allowed.shape, low, high)).any(axis=0)
        if refused.any():
            raise _refusal(f"{where}, observed site {name!r}", family, np.asarray(values[0]), refused)


def _limits(message: Mapping[str, Any]) -> tuple[jax.Array, jax.Array]:
    """The least and the largest value that each entry of a site can have, infinite where there is none."""
    one, shape = base_constraint(message["fn"].support), jnp.shape(message["value"])
    ends = getattr(one, "lower_bound", -jnp.inf), getattr(one, "upper_bound", jnp.inf)
    return jnp.broadcast_to(ends[0], shape), jnp.broadcast_to(ends[1], shape)


def _moves(end: np.ndarray) -> np.ndarray:
    """Where a support's end, (draw, ...), is not the same at all draws."""
    return (end != end[:1]).any(axis=0)


def _beyond_moving(
    values: np.ndarray, shape: tuple[int, ...], low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Which values are outside on a side that moves, so that another draw may allow them, of a shape (draw, *batch)."""
    beyond = (_moves(low) & (values < low)) | (_moves(high) & (values > high))
    return beyond.reshape(*shape, -1).any(axis=-1)


def _each(one: Callable[..., Any], axes: Mapping[str, int | None]) -> Callable[..., Any]:
    """A function of arrays and a key for each data set, where some arrays have an axis of data sets."""
    return jax.vmap(one, in_axes=(dict(axes), None)) if 0 in axes.values() else one


def _ends(support: Any) -> tuple[Any, ...] | None:
    """The finite ends of a support; None of one of which nothing is refused."""
    one = base_constraint(support)
    if type(one).__name__.strip("_") in _ANY:
        return None
    return tuple(getattr(one, end) for end in ("lower_bound", "upper_bound") if hasattr(one, end))


def _allows(fn: Any, value: jax.Array) -> jax.Array:
    """Which values (*batch) a distribution can take; those at an end of a continuous one if its density is finite there."""
    inside, (_, mask) = fn.support(value), unwrapped(fn)
    event = tuple(range(value.ndim - len(fn.event_shape), value.ndim))
    if not fn.is_discrete:
        at_end = sum((value == end for end in _ends(fn.support) or ()), jnp.zeros(value.shape, bool)) > 0
        inside = jnp.where(at_end.any(axis=event), jnp.isfinite(fn.log_prob(value)), inside)
    return inside if mask is None else inside | ~jnp.broadcast_to(mask, value.shape).any(axis=event)


def _refusal(where: str, family: str, value: np.ndarray, refused: np.ndarray) -> InputError:
    first = tuple(int(i) for i in np.argwhere(refused)[0])
    got = np.array2string(value[first], separator=", ", threshold=8)
    more = f" and {refused.sum() - 1} more" if refused.sum() > 1 else ""
    return InputError(
        where,
        f"values that {family} can take",
        f"{got} at [{', '.join(map(str, first))}]{more}",
        "Correct them, mark them as missing, or observe a distribution that can take them",
    )
