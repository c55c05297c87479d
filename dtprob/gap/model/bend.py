"""How a model's tangents change with the spread of its observations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dtprob.gap.model.quick import quick_jit
from dtprob.gap.model.running import Arrays, Runner
from dtprob.gap.observation import whiten


def bending(runner: Runner) -> Callable[[Any, Any, Any, Arrays], dict[str, jax.Array]]:
    """(x, weights (cluster, row, k), basis (k, dimension), arrays) -> slopes of <weights, tangents along the basis>.

    They are taken in whitened steps of the spread of each observation, (*value) by site.

    Args:
        runner: the model.
    """

    @quick_jit
    def bend(x: Any, weights: jax.Array, basis: jax.Array, arrays: Any) -> dict[str, jax.Array]:
        def total(steps: dict[str, jax.Array]) -> jax.Array:
            def parameters(x: Any) -> dict[str, whiten.Parameters]:
                observed = runner.around(runner.run(x, arrays, {}).parameters)
                return {
                    n: (whiten.moved(o, steps[n], spread=True) or o).parameters for n, o in observed.items()
                }

            @jax.checkpoint  # of many directions one at a time is held
            def along(direction: jax.Array, weight: jax.Array) -> jax.Array:
                here, tangent = jax.jvp(parameters, (x,), (direction,))
                shifts = {n: whiten.shift(o, tangent[n]) for n, o in runner.around(here).items()}
                return jnp.sum(weight * runner.rows.stack(shifts))

            return jnp.sum(jax.lax.map(lambda one: along(*one), (basis, jnp.moveaxis(weights, -1, 0))))

        return jax.grad(total)({name: jnp.zeros(shape[1:]) for name, shape in runner.rows.shapes.items()})

    return lambda x, weights, basis, arrays: bend(jnp.asarray(x), weights, basis, arrays)
