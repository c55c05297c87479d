"""How a model's tangents change from place to place: with its coordinates, its sites and its distributions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from dtprob.gap.model.quick import quick_jit
from dtprob.gap.model.running import Arrays, Runner
from dtprob.gap.observation import whiten


class Bend(NamedTuple):
    """Slopes of a number, or where they are taken.

    Attributes:
        x: in the flat vector (dimension,).
        sites: in each deterministic site (*site).
        rows: in whitened steps of each observation's location and of its spread (2, *value).
    """

    x: Any
    sites: dict[str, Any]
    rows: dict[str, Any]


def bending(
    runner: Runner, float_sites: Mapping[str, jax.ShapeDtypeStruct]
) -> Callable[[Any, Any, Any, Arrays], Bend]:
    """(x, weights (cluster, row, k), basis (k, dimension), arrays) -> slopes of <weights, tangents along the basis>.

    Args:
        runner: the model.
        float_sites: deterministic sites that may be moved, in the largest shape that a candidate gives them.
    """

    @quick_jit
    def bend(x: Any, weights: jax.Array, basis: jax.Array, arrays: Any) -> Bend:
        deltas = {name: jnp.zeros(s.shape, s.dtype) for name, s in float_sites.items()}
        steps = {name: jnp.zeros((2, *shape[1:])) for name, shape in runner.shapes.items()}

        def total(at: Bend) -> jax.Array:
            def parameters(x: Any) -> dict[str, whiten.Parameters]:
                observed = runner.around(runner.run(x, arrays, at.sites).parameters)
                return {n: whiten.stepped(o, *at.rows[n]).parameters for n, o in observed.items()}

            @jax.checkpoint  # of many directions one at a time is held
            def along(direction: jax.Array, weight: jax.Array) -> jax.Array:
                here, tangent = jax.jvp(parameters, (at.x,), (direction,))
                shifts = {n: whiten.shift(o, tangent[n]) for n, o in runner.around(here).items()}
                return jnp.sum(weight * runner.rows.stack(shifts))

            return jnp.sum(jax.lax.map(lambda one: along(*one), (basis, jnp.moveaxis(weights, -1, 0))))

        return jax.grad(total)(Bend(x, deltas, steps))

    return lambda x, weights, basis, arrays: bend(jnp.asarray(x), weights, basis, arrays)
