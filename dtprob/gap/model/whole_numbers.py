"""Sites of whole numbers as real ones, so that effects and what is left can act on them by less than one.

Numbers that point into arrays, and those that a model can only take as whole ones, stay what they are.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dtprob.effects.changing import Changing, Shift
from dtprob.errors import InputError
from dtprob.gap.observation import whiten
from dtprob.models.arguments import Data, Model, split_static, within
from dtprob.models.declaration import is_factor
from dtprob.models.execution import NOT_TRACED, trace_model

_SAME: Final = 1e-6
"""Relative change of what is observed that rounding may make."""

type _Told = dict[str, tuple[jax.Array, whiten.Parameters]]


class _Real(Changing):
    """Makes deterministic sites real."""

    is_sum = True

    def __init__(self, names: Collection[str]) -> None:
        super().__init__(None)
        self._names = names

    def touches(self, name: str) -> bool:
        return name in self._names

    def change(self, msg: Mapping[str, Any]) -> Any:
        return jnp.asarray(msg["value"]).astype(float)


def real_sites(model: Model, data: Data) -> Model:
    """The model with its deterministic sites of whole numbers made real, as far as that changes nothing; or itself.

    A site stays as it is where the model does not run with real numbers there, as where it is an index, where what is
    observed would be others or of another law, and where a law has no finite derivative in them, as (-1) ** n in n.

    Args:
        model: any model.
        data: its arguments by name.
    """
    arrays, static = split_static(data)
    key = jax.random.key(0)

    def sites(arrays: Any) -> dict[str, Any]:
        trace = trace_model(model, eqx.combine(arrays, static), key)
        found = {n: m["value"] for n, m in trace.items() if m["type"] == "deterministic"}
        return {n: v for n, v in found.items() if hasattr(v, "dtype")}  # plain numbers may be sizes

    shapes: dict[str, jax.ShapeDtypeStruct] = jax.eval_shape(sites, arrays)
    whole = [n for n, s in shapes.items() if jnp.issubdtype(s.dtype, jnp.integer) and s.size]
    if not whole:
        return model

    def told(names: Collection[str], deltas: Mapping[str, Any], arrays: Any) -> _Told:
        with Shift(deltas), _Real(names):
            trace = trace_model(model, eqx.combine(arrays, static), key)
        observed = {
            n: m for n, m in trace.items() if m["type"] == "sample" and m["is_observed"] and not is_factor(m)
        }
        return {
            n: (jnp.asarray(m["value"]), whiten.observation(m["fn"], m["value"], n).parameters)
            for n, m in observed.items()
        }

    def is_same(names: Collection[str]) -> bool:
        def both(arrays: Any) -> tuple[_Told, _Told, list[jax.Array]]:
            zero = {n: jnp.zeros(shapes[n].shape) for n in names}
            one = {n: jnp.ones(shapes[n].shape) for n in names}
            real, slope = jax.jvp(lambda deltas: told(names, deltas, arrays), (zero,), (one,))
            slopes = [t for t in jax.tree.leaves(slope) if jnp.issubdtype(t.dtype, jnp.inexact)]
            return told((), {}, arrays), real, slopes

        try:
            before, after, slope = jax.jit(both)(arrays)
        except (TypeError, ValueError, IndexError, InputError, *NOT_TRACED):
            return False
        pairs = list(zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True))
        return all(_agree(b, a) for b, a in pairs) and all(np.isfinite(np.asarray(t)).all() for t in slope)

    kept = whole if is_same(whole) else [n for n in whole if is_same([n])]
    return within(model, lambda: _Real(kept)) if kept else model


def _agree(before: jax.Array, after: jax.Array) -> bool:
    """Whether two arrays are of one kind and hold the same numbers."""
    same = before.dtype == after.dtype and before.shape == after.shape
    return same and np.allclose(np.asarray(before), np.asarray(after), rtol=_SAME, atol=0.0, equal_nan=True)
