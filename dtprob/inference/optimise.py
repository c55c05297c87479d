"""Minimisation of a negative log density: from several starts, with an honest answer to whether it arrived.

Up to a few hundred dimensions: Newton steps in a trust region with the exact Hessian. Its eigenvalues are
taken by absolute value, so that the step leads down where the function is not convex (Dauphin et al.,
Identifying and attacking the saddle point problem, 2014). Measured channels give log densities whose
curvatures span ten decades; first-order methods stop short there, and optimistix has no minimiser that
takes a Hessian. Above: L-BFGS of optimistix.

Arrival is judged in nats: the decrease that a Newton step still promises.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, Scalar

type Objective = Callable[[Array], Array]

DENSE_LIMIT = 300
_HESSIAN_BATCH = 32
_NATS = 1e-9
_LBFGS_NATS = 1e-3
_SHRINK = 0.25
_GROW = 3.0
_TRIES = 12
_BISECTIONS = 40


class Optimum(NamedTuple):
    """Where a minimisation ended.

    Attributes:
        position: the point, (dimension,).
        value: the function there.
        promise: the decrease in nats that a further step promises.
        converged: whether `promise` is within tolerance.
        steps: steps taken.
    """

    position: Float[Array, " dimension"]
    value: Scalar
    promise: Scalar
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


class Curvature(NamedTuple):
    """Eigenvalues, ascending, and eigenvectors (columns) of a Hessian."""

    values: Float[Array, " dimension"]
    vectors: Float[Array, "dimension dimension"]


def minimise(function: Objective, start: Float[Array, " dimension"], max_steps: int) -> Optimum:
    """A local minimum of `function` near `start`.

    Args:
        function: vector -> scalar, in nats.
        start: where to begin.
        max_steps: bound on Newton steps; L-BFGS gets ten times as many.
    """
    if start.shape[0] <= DENSE_LIMIT:
        return newton(function, start, max_steps)
    return _lbfgs(function, start, 10 * max_steps)


def best(optima: Optimum) -> Optimum:
    """Of several optima (leading axis), the one with the lowest finite value."""
    values = jnp.where(jnp.isfinite(optima.value), optima.value, jnp.inf)
    return jax.tree.map(lambda x: x[jnp.argmin(values)], optima)


def gradient_and_hessian(
    function: Objective, position: Float[Array, " dimension"]
) -> tuple[Float[Array, " dimension"], Float[Array, "dimension dimension"]]:
    """Gradient and Hessian, the latter a block of columns at a time to bound the memory."""
    dimension = position.shape[0]
    size = min(max(dimension, 1), _HESSIAN_BATCH)
    directions = jnp.eye(dimension + -dimension % size, dimension, dtype=position.dtype)
    gradient, product = jax.linearize(jax.grad(function), position)
    matrix = jax.lax.map(product, directions, batch_size=size)[:dimension]
    return gradient, 0.5 * (matrix + matrix.T)


def curvature(matrix: Float[Array, "dimension dimension"]) -> Curvature:
    """Eigen-decomposition of a symmetric matrix, zeros where an entry is not finite."""
    return Curvature(*jnp.linalg.eigh(jnp.nan_to_num(matrix, posinf=0.0, neginf=0.0)))


class _State(NamedTuple):
    optimum: Optimum
    radius: Array
    stuck: Array


def newton(function: Objective, start: Float[Array, " dimension"], max_steps: int) -> Optimum:
    """Trust-region Newton with the exact Hessian; the value never rises.

    Args:
        function: vector -> scalar, in nats.
        start: where to begin; where the function is not finite there, the start is returned, not converged.
        max_steps: bound on the steps.
    """

    def unfinished(state: _State) -> Array:
        return ~state.optimum.converged & ~state.stuck & (state.optimum.steps <= max_steps)

    def advance(state: _State) -> _State:
        now = state.optimum
        value = function(now.position)
        gradient, matrix = gradient_and_hessian(function, now.position)
        spectrum = curvature(matrix)
        promise = 0.5 * jnp.sum((spectrum.vectors.T @ gradient) ** 2 / _positive(spectrum.values))
        finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))
        done = finite & (promise <= _tolerance(value))
        stop = done | ~finite | (now.steps == max_steps)
        here = now._replace(value=value, promise=promise, converged=done, steps=now.steps + ~stop)
        return _descend(function, _State(here, state.radius, stop), gradient, spectrum)

    infinite = jnp.asarray(jnp.inf, start.dtype)
    radius = jnp.asarray(2.0 * max(start.shape[0], 1) ** 0.5, start.dtype)
    no = jnp.zeros((), dtype=bool)
    first = _State(Optimum(start, infinite, infinite, no, jnp.zeros((), dtype=int)), radius, no)
    return jax.lax.while_loop(unfinished, advance, first).optimum


def _tolerance(value: Array) -> Array:
    """What cannot be told from rounding, or is too little to matter, nats."""
    return jnp.maximum(_NATS, 10 * jnp.finfo(value.dtype).eps * jnp.abs(value))


def _positive(eigenvalues: Array) -> Array:
    floor = jnp.finfo(eigenvalues.dtype).eps * jnp.max(jnp.abs(eigenvalues), initial=0.0)
    return jnp.maximum(jnp.abs(eigenvalues), jnp.maximum(floor, jnp.finfo(eigenvalues.dtype).tiny ** 0.5))


def _descend(function: Objective, state: _State, gradient: Array, spectrum: Curvature) -> _State:
    """Unless the state has stopped, shrink the trust region until a step lowers the function."""
    now = state.optimum

    def rejected(carry: tuple[Array, Array, Array, Array]) -> Array:
        _, value, _, tries = carry
        return ~(value < now.value) & (tries < _TRIES) & ~state.stuck

    def attempt(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        _, _, radius, tries = carry
        step = _step(gradient, spectrum, radius)
        length = jnp.linalg.norm(step)
        value = function(now.position + step)
        wider = jnp.where(length > 0.9 * radius, _GROW * radius, radius)
        return now.position + step, value, jnp.where(value < now.value, wider, _SHRINK * length), tries + 1

    nowhere = (now.position, jnp.full_like(now.value, jnp.inf), state.radius, jnp.zeros((), dtype=int))
    position, value, radius, _ = jax.lax.while_loop(rejected, attempt, nowhere)
    lower = value < now.value
    moved = now._replace(
        position=jnp.where(lower, position, now.position), value=jnp.where(lower, value, now.value)
    )
    return _State(moved, radius, ~lower)


def _step(gradient: Array, spectrum: Curvature, radius: Array) -> Array:
    """The step that minimises the model with |eigenvalues| within the radius."""
    projected = spectrum.vectors.T @ gradient
    positive = _positive(spectrum.values)

    def length(damping: Array) -> Array:
        return jnp.linalg.norm(projected / (positive + damping))

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = jnp.sqrt(low * high)
        too_long = length(middle) > radius
        return jnp.where(too_long, middle, low), jnp.where(too_long, high, middle)

    highest = jnp.linalg.norm(projected) / radius
    lowest = highest * jnp.finfo(gradient.dtype).eps ** 2
    _, damping = jax.lax.fori_loop(0, _BISECTIONS, halve, (lowest, highest))
    damping = jnp.where(length(jnp.zeros_like(radius)) <= radius, 0.0, damping)
    return -spectrum.vectors @ (projected / (positive + damping))


def _lbfgs(function: Objective, start: Float[Array, " dimension"], max_steps: int) -> Optimum:
    solver = optx.LBFGS(rtol=1e-10, atol=1e-10, history_length=30)
    solution = optx.minimise(
        lambda u, _: function(u),
        solver,
        start,
        max_steps=max_steps,
        throw=False,
        adjoint=optx.ImplicitAdjoint(),
    )
    position = solution.value
    value, gradient = jax.value_and_grad(function)(position)
    # In units of the prior the curvature is one or more, so half the squared gradient bounds the promise.
    promise = 0.5 * jnp.sum(gradient**2)
    converged = jnp.isfinite(value) & (promise <= _LBFGS_NATS)
    return Optimum(position, value, promise, converged, solution.stats["num_steps"])
