"""Residuals of a model at a point, and how they change along directions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, Final, final

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.gap.model.one_by_one import one_by_one
from dtprob.gap.model.running import Arrays, Runner
from dtprob.gap.observation import whiten

CHUNK: Final = 16
"""Directions or perturbations that go through a compiled program at a time."""
_WIDE: Final = 32
"""Entries of an unknown that all clusters share from which tangents along it are taken by themselves."""

type _Program = Callable[[np.ndarray, np.ndarray, Arrays], tuple[jax.Array, jax.Array]]
"""(x, basis (k, dimension), arrays) -> whitened residuals (cluster, row), tangents (cluster, row, k)."""


@final
class Tangents:
    """What a linearised model says at a point.

    Directions that move nothing but unknowns of many entries, such as the states of a Gaussian process, do not pass
    through what these do not enter: the Cholesky factor of its covariance would be differentiated along each of them.

    Args:
        runner: the model.
    """

    def __init__(self, runner: Runner) -> None:
        self._runner = runner

    def __call__(self, x: np.ndarray, basis: np.ndarray, arrays: Arrays) -> tuple[jax.Array, jax.Array]:
        """Whitened residuals (cluster, row) at x, and tangents (cluster, row, k) along a basis (k, dimension)."""
        is_wide = self._moves_wide_alone(basis)
        if not is_wide.any():
            return self._along_all(x, basis, arrays)
        if is_wide.all():
            return self._along_wide(x, basis, arrays)
        residual, along = self._along_all(x, basis[~is_wide], arrays)
        within = self._along_wide(x, basis[is_wide], arrays)[1]
        order = np.argsort(np.concatenate([np.flatnonzero(~is_wide), np.flatnonzero(is_wide)]))
        return residual, jnp.concatenate([along, within], axis=-1)[..., order]

    @cached_property
    def _wide(self) -> dict[str, np.ndarray]:
        """Positions of the base model's unknowns with many entries, none of which belongs to a cluster, by name."""
        blocks = self._runner.layout.blocks
        return {b.name: b.index for b in blocks if b.owner is None and not b.local and b.size >= _WIDE}

    def _moves_wide_alone(self, basis: np.ndarray) -> np.ndarray:
        if not self._wide:
            return np.zeros(len(basis), bool)
        others = np.ones(basis.shape[1], bool)
        for index in self._wide.values():
            others[index] = False
        return ~np.any(basis[:, others], axis=1)

    @cached_property
    def _along_all(self) -> _Program:
        return self._program(lambda x: x, lambda _whole, moved: moved)

    @cached_property
    def _along_wide(self) -> _Program:
        layout = self._runner.layout

        def beside(whole: jax.Array, moved: dict[str, jax.Array]) -> dict[str, jax.Array]:
            return {**layout.split(whole), **moved}

        return self._program(lambda x: {name: layout.part(x, name) for name in self._wide}, beside)

    def _program(
        self, taken: Callable[[jax.Array], Any], beside: Callable[[jax.Array, Any], Any]
    ) -> _Program:
        """Along what is taken of a flat vector; `beside` puts that together with the rest of one."""
        runner = self._runner

        @jax.jit
        def linearised(x: Any, basis: jax.Array, count: Any, arrays: Arrays) -> tuple[jax.Array, jax.Array]:
            def parameters(moved: Any) -> tuple[dict[str, whiten.Parameters], dict[str, jax.Array]]:
                found = runner.run(beside(x, moved), arrays, {})
                return found.parameters, found.values

            here, push, values = jax.linearize(parameters, taken(x), has_aux=True)
            rows = {n: whiten.about(o) for n, o in runner.around(here).items()}
            residual = {n: row.residual(values[n]) for n, row in rows.items()}

            def shifted(i: Any) -> jax.Array:
                tangent = push(taken(basis[i]))
                return runner.rows.stack({n: row.shift(tangent[n]) for n, row in rows.items()})

            one = jax.eval_shape(shifted, 0)
            columns = one_by_one(shifted, count, jnp.zeros((CHUNK, *one.shape), one.dtype))
            return runner.rows.stack(residual), jnp.moveaxis(columns, 0, -1)

        def chunked(x: np.ndarray, basis: np.ndarray, arrays: Arrays) -> tuple[jax.Array, jax.Array]:
            parts = [linearised(jnp.asarray(x), *chunk, arrays) for chunk in chunks(basis)]
            columns = parts[0][1] if len(parts) == 1 else jnp.concatenate([c for _, c in parts], axis=-1)
            return parts[0][0], columns[..., : len(basis)]

        return chunked


def chunks(basis: np.ndarray) -> Iterator[tuple[jax.Array, int]]:
    """Rows of a basis in chunks of one size, at least one, the last filled up with zeros, and how many of each count."""
    count = max(-(-len(basis) // CHUNK), 1)
    padded = np.concatenate([basis, np.zeros((count * CHUNK - len(basis), basis.shape[1]))])
    for start in range(0, len(padded), CHUNK):
        yield jnp.asarray(padded[start : start + CHUNK]), min(len(basis) - start, CHUNK)
