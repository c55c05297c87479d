"""Which arguments of a model tell what was observed, so that they explain nothing, and which entries of it count."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from dtprob.gap.model.declared import Declared
from dtprob.gap.model.quick import quick_jit
from dtprob.gap.model.running import observations


def responses(declared: Declared, arrays: Any) -> frozenset[str]:
    """Names of the arguments that hold observed values, are turned into them, or tell which readings are censored.

    Args:
        declared: the model.
        arrays: its arguments that are arrays, by name.
    """
    observed = declared.declaration.observed
    named = {site.argument for site in observed.values() if site.argument is not None}
    computed = [name for name, site in observed.items() if site.argument is None]

    @quick_jit
    def seen(arrays: Any) -> list[Any]:
        trace = declared.trace(arrays)
        flags = [o.parameters.get("censored") for o in observations(declared.declaration, trace).values()]
        return [jnp.asarray(trace[name]["value"]) for name in computed] + [f for f in flags if f is not None]

    before = [np.asarray(value) for value in seen(arrays)]
    found = set(named)
    for name in arrays if before else ():
        if name not in named and eqx.is_array(arrays[name]) and arrays[name].ndim:
            after = seen({**arrays, name: jnp.roll(arrays[name].reshape(-1), 1).reshape(arrays[name].shape)})
            if any(not np.array_equal(a, b) for a, b in zip(after, before, strict=True)):
                found.add(name)
    return frozenset(found)


def counted(declared: Declared, arrays: Any) -> dict[str, Bool[np.ndarray, "*site"]]:
    """Which entries of each observed site count: all that its mask, if it has one, does not leave out.

    Args:
        declared: the model.
        arrays: its arguments that are arrays, by name.
    """

    @quick_jit
    def masks(arrays: Any) -> dict[str, Any]:
        found = observations(declared.declaration, declared.trace(arrays))
        return {n: o.parameters["mask"] for n, o in found.items() if "mask" in o.parameters}

    found, sites = masks(arrays), declared.declaration.observed
    return {n: np.broadcast_to(np.asarray(found.get(n, 1.0)) > 0, site.shape) for n, site in sites.items()}
