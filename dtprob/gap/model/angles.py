"""Angles that a model draws uniformly from a whole turn: coordinates without a cut, where nothing changes across it.

A phase near an end of `Uniform(-pi, pi)` cannot cross it, and a fit that came from the other side stays there.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any, Final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from numpyro.primitives import Messenger

from dtprob.models.arguments import Data, Model, split_static, within
from dtprob.models.declaration import innermost
from dtprob.models.execution import trace_model

_TURN: Final = 2 * math.pi
_FLAT: Final = 1e-3
"""Concentration of an angle that may be anything."""
_SAME: Final = 1e-3
"""Nats that a whole turn may change, for each thousand of the log density."""


class _Round(Messenger):
    """Draws sites from the circle."""

    def __init__(self, names: Collection[str]) -> None:
        super().__init__(None)
        self._names = names

    def process_message(self, msg: dict[str, Any]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        if msg["type"] == "sample" and msg["name"] in self._names:
            fn = msg["fn"]
            own = innermost(fn)
            flat = dist.VonMises((own.low + own.high) / 2, _FLAT)
            msg["fn"] = flat.expand(fn.batch_shape + fn.event_shape).to_event(fn.event_dim)


def unrolled(model: Model, data: Data) -> Model:
    """The model with such angles drawn from the circle; itself where there are none.

    Args:
        model: any model.
        data: its arguments by name.
    """
    arrays, static = split_static(data)
    names: list[str] = []

    def found(arrays: Any, key: jax.Array) -> dict[str, jax.Array]:
        trace = trace_model(model, eqx.combine(arrays, static), key)
        own = {
            n: innermost(m["fn"]) for n, m in trace.items() if m["type"] == "sample" and not m["is_observed"]
        }
        uniform = {n: fn for n, fn in own.items() if type(fn) is dist.Uniform}
        names.extend(uniform)
        return {
            n: jnp.abs(jnp.asarray(fn.high) - jnp.asarray(fn.low) - _TURN).max() for n, fn in uniform.items()
        }

    key = jax.random.key(0)
    jax.eval_shape(found, arrays, key)
    if not names:
        return model
    widths = jax.jit(found)(arrays, key)
    whole = [n for n, off in widths.items() if off < 1e-3 and _is_periodic(model, arrays, static, n)]
    if not whole:
        return model

    return within(model, lambda: _Round(whole))


def _is_periodic(model: Model, arrays: Any, static: Any, name: str) -> bool:
    """Whether a turn more changes nothing but the angle's own density."""

    def density(key: jax.Array, turns: jax.Array) -> jax.Array:
        data = eqx.combine(arrays, static)
        value = trace_model(model, data, key)[name]["value"]
        trace = trace_model(model, data, key, {name: value + _TURN * turns})
        others = [m for n, m in trace.items() if m["type"] == "sample" and n != name]
        return jnp.stack([jnp.sum(m["fn"].log_prob(m["value"])) for m in others])

    run = jax.jit(density)
    keys = jax.random.split(jax.random.key(0), 3)
    pairs = [(np.asarray(run(k, jnp.zeros(()))), np.asarray(run(k, jnp.ones(())))) for k in keys]
    return all(np.allclose(here, there, rtol=_SAME, atol=_SAME) for here, there in pairs)
