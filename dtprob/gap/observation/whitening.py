"""Rows of unit covariance from the scores of a distribution and their covariance."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

from dtprob.gap.observation.likelihood import About, Likelihood, Move, Rows
from dtprob.gap.observation.residuals import Parameters

_RIDGE: Final = 1e-10
"""Share of the mean information that is added to each score's, where two of them cannot be told apart."""


class Scores(NamedTuple):
    """Scores of a distribution, not yet whitened.

    Attributes:
        of: (parameters, values) -> scores (score, *value).
        information: parameters -> their covariance (*value, score, score).
        change: (parameters, a change of each) -> what goes with each score (score, *value).
    """

    of: Rows
    information: Callable[[Parameters], jax.Array]
    change: Rows


def whitened(made: Likelihood, scores: Scores, move: Move | None) -> Likelihood:
    """The likelihood with rows of unit covariance; a move of what goes with the first score alone moves the first row.

    Where the information is none or not finite, as where all of a mixture is certain, a row tells nothing.
    """

    def rooted(p: Parameters) -> tuple[jax.Array, jax.Array]:
        """Roots of the information (*value, score, score), and where there is any (*value,)."""
        information = scores.information(p)
        size, trace = information.shape[-1], jnp.trace(information, axis1=-2, axis2=-1)
        told = jnp.isfinite(information).all(axis=(-2, -1)) & (trace > 0)
        ridge = _RIDGE * trace / size
        held = information + ridge[..., None, None] * jnp.eye(size)
        return jnp.linalg.cholesky(jnp.where(told[..., None, None], held, jnp.eye(size))), told

    def about(p: Parameters) -> About:
        root, told = rooted(p)

        def residual(value: Any) -> jax.Array:
            columns = jnp.moveaxis(jnp.where(told, scores.of(p, value), 0.0), 0, -1)[..., None]
            return jnp.moveaxis(solve_triangular(root, columns, lower=True)[..., 0], -1, 0)

        def shift(change: Parameters) -> jax.Array:
            return jnp.einsum("...ij,i...->j...", root, jnp.where(told, scores.change(p, change), 0.0))

        return About(residual, shift)

    relocate: Move | None = None if move is None else lambda p, step: move(p, step / rooted(p)[0][..., 0, 0])
    return replace(
        made,
        residual=lambda p, value: about(p).residual(value),
        shift=lambda p, change: about(p).shift(change),
        about=about,
        relocate=relocate,
    )


def made_of(base: Likelihood, make: Callable[..., Any], further: Mapping[str, int], mean: Any) -> Likelihood:
    """What is made of a base by parameters beside its own; rows are still to come."""
    return Likelihood(
        make,
        tuple(dict.fromkeys((*base.parameters, *further))),
        base.residual,
        base.shift,
        located=1,
        mean=mean,
        trailing={**base.trailing, **further},
    )


def own_of(base: Likelihood, p: Parameters) -> Parameters:
    """The base's parameters among those of what is made of it."""
    return {name: p[name] for name in base.parameters}


def shift_of(base: Likelihood) -> Rows:
    """What a change of the base's parameters, among others, adds to its rows."""
    return lambda p, change: base.shift(own_of(base, p), own_of(base, change))


def outer(one: jax.Array, other: jax.Array) -> jax.Array:
    """Products (*value, i, j) of rows (i, *value) and (j, *value)."""
    return jnp.einsum("i...,j...->...ij", one, other)
