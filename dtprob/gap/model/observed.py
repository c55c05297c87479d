"""What was observed: its values, which entries of it count, and which arguments of a model tell it."""

from __future__ import annotations

from functools import cached_property
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from dtprob.gap.model.declared import Declared
from dtprob.gap.model.quick import quick_jit
from dtprob.gap.model.running import observations


@final
class Observed:
    """What a model's data say of its observed sites.

    Args:
        declared: the model.
        arrays: its arguments that are arrays, by name.
    """

    def __init__(self, declared: Declared, arrays: Any) -> None:
        self._declared, self._arrays = declared, arrays

    @cached_property
    def values(self) -> dict[str, jax.Array]:
        """The data of each observed site."""

        @quick_jit
        def run(arrays: Any) -> dict[str, jax.Array]:
            trace = self._declared.trace(arrays)
            return {name: jnp.asarray(trace[name]["value"]) for name in self._declared.declaration.observed}

        return run(self._arrays)

    @cached_property
    def counted(self) -> dict[str, Bool[np.ndarray, "*site"]]:
        """Which entries of each site count: all that its mask, if it has one, does not leave out."""
        declaration = self._declared.declaration

        @quick_jit
        def masks(arrays: Any) -> dict[str, Any]:
            found = observations(declaration, self._declared.trace(arrays))
            return {n: o.parameters["mask"] for n, o in found.items() if "mask" in o.parameters}

        found, sites = masks(self._arrays), declaration.observed
        return {
            n: np.broadcast_to(np.asarray(found.get(n, 1.0)) > 0, site.shape) for n, site in sites.items()
        }

    @cached_property
    def count(self) -> int:
        """Entries that count, a complex one once."""
        return sum(int(entries.sum()) for entries in self.counted.values())

    @cached_property
    def arguments(self) -> frozenset[str]:
        """Arguments that hold observed values, are turned into them, or tell which readings are censored.

        They explain nothing.
        """
        declared, arrays = self._declared, self._arrays
        observed = declared.declaration.observed
        named = {site.argument for site in observed.values() if site.argument is not None}
        computed = [name for name, site in observed.items() if site.argument is None]

        @quick_jit
        def seen(arrays: Any) -> list[Any]:
            trace = declared.trace(arrays)
            found = observations(declared.declaration, trace).values()
            flags = [o.parameters.get("censored") for o in found]
            values = [jnp.asarray(trace[name]["value"]) for name in computed]
            return values + [f for f in flags if f is not None]

        before = [np.asarray(value) for value in seen(arrays)]
        found = set(named)
        for name in arrays if before else ():
            if name not in named and eqx.is_array(arrays[name]) and arrays[name].ndim:
                rolled = jnp.roll(arrays[name].reshape(-1), 1).reshape(arrays[name].shape)
                after = seen({**arrays, name: rolled})
                if any(not np.array_equal(a, b) for a, b in zip(after, before, strict=True)):
                    found.add(name)
        return frozenset(found)
