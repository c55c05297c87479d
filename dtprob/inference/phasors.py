"""Least squares for the phases of Gaussian observations: a start, and the reference E-step.

Where every observation is normal with a mean affine in x_e = (cos z_e, sin z_e), the x_e are found as if
they were free, and their directions kept: the reference E-step of Ruah et al. (arXiv 2312.12625), with the
prior's natural parameter added to the right-hand side. It needs only the observations' means as functions
of the angles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro.distributions import constraints

from dtprob.inference.relaxation import Layout, Resultants
from dtprob.inference.target import Inputs, Target
from dtprob.models.declaration import base_constraint

_NORMAL = ("Normal", "ComplexNormal")
_WHOLE = (constraints.real, constraints.complex)
_ITERATIONS = 200


def is_gaussian(target: Target) -> bool:
    """Whether all observed sites, and there are some, are normal, real or complex; LogNormal, whose base is, is not."""
    observed = target.declaration.observed.values()
    return bool(observed) and all(
        site.distribution in _NORMAL and base_constraint(site.support) in _WHOLE for site in observed
    )


def least_squares_start(
    target: Target, layout: Layout, rest: Float[Array, " dimension"], inputs: Inputs
) -> Resultants:
    """Angles by least squares on the phasors.

    Args:
        target: a target whose observations are Gaussian.
        layout: the groups and colours of the angles.
        rest: all coordinates; those of the angles are not used.
        inputs: the target's arrays.
    """
    return _solution(_equations(target, rest, inputs), layout)


def reference_phases(
    target: Target, layout: Layout, rest: Float[Array, " dimension"], inputs: Inputs
) -> tuple[Float[Array, "group colour"], Float[Array, "group colour"]]:
    """Directions (rad) and concentrations of the angles by the E-step of Ruah et al..

    Directions are those of least squares; with SNR the squared amplitude of a path over the noise power, the
    concentration is 2 sqrt(SNR (SNR - 1)), and 0 where SNR is below 1.

    Args:
        target: a target whose observations are complex normal.
        layout: the groups and colours of the angles.
        rest: all coordinates; those of the angles are not used.
        inputs: the target's arrays.
    """
    equations = _equations(target, rest, inputs)

    def own(colour: Array) -> Float[Array, " group"]:
        entries = layout.table[:, colour]  # of different groups, which do not meet in the data
        one = jnp.zeros((target.angles.size, 2), rest.dtype).at[entries, 0].set(1.0)
        return 0.5 * equations.product(one)[entries, 0]

    snr = jax.lax.map(own, jnp.arange(layout.table.shape[1])).T
    return _solution(equations, layout).direction, 2 * jnp.sqrt(snr * jnp.maximum(snr - 1, 0.0))


class _Equations(NamedTuple):
    """The normal equations of least squares: the product with their matrix, and their right-hand side."""

    product: Callable[[Float[Array, "angle 2"]], Float[Array, "angle 2"]]
    right: Float[Array, "angle 2"]


def _equations(target: Target, rest: Array, inputs: Inputs) -> _Equations:
    zero = jnp.zeros(target.angles.shape, rest.dtype)
    quarter = zero + 0.5 * jnp.pi
    data, _, weight = _observations(target, zero, rest, inputs)

    def mean(angles: Array) -> Array:
        return _observations(target, angles, rest, inputs)[1]

    def forward(x: Array) -> Array:
        from_cos = jax.jvp(mean, (quarter,), (-x[:, 0],))[1]
        return from_cos + jax.jvp(mean, (zero,), (x[:, 1],))[1]

    base = 0.5 * (mean(zero) + mean(zero + jnp.pi))
    _, backward = jax.vjp(forward, jnp.zeros((zero.shape[0], 2), rest.dtype))
    right = backward(weight * (data - base))[0] + _prior_parameter(target, rest, inputs)
    return _Equations(lambda x: backward(weight * forward(x))[0], right)


def _solution(equations: _Equations, layout: Layout) -> Resultants:
    found, _ = jax.scipy.sparse.linalg.cg(equations.product, equations.right, maxiter=_ITERATIONS, tol=1e-8)
    found = jnp.where(jnp.isfinite(found), found, 0.0)[layout.table]
    length = jnp.minimum(jnp.linalg.norm(found, axis=-1), 1.0)
    return Resultants(jnp.arctan2(found[..., 1], found[..., 0]), length)


def _prior_parameter(target: Target, rest: Array, inputs: Inputs) -> Float[Array, "angle 2"]:
    """D log prior / d x of each entry."""

    def prior(angles: Array) -> Array:
        return target.log_terms(rest.at[target.angles].set(angles), inputs).prior

    zero = jnp.zeros(target.angles.shape, rest.dtype)
    return jnp.stack([-jax.grad(prior)(zero + 0.5 * jnp.pi), jax.grad(prior)(zero)], axis=-1)


def _observations(target: Target, angles: Array, rest: Array, inputs: Inputs) -> tuple[Array, Array, Array]:
    """Data, means and weights (one over the variance, 0 where masked) of all observations, as real vectors."""
    _, trace = target.trace(rest.at[target.angles].set(angles), inputs)
    parts: list[tuple[Array, Array, Array]] = []
    for name in target.declaration.observed:
        fn, value = trace[name]["fn"], jnp.asarray(trace[name]["value"])
        mean = jnp.broadcast_to(fn.mean, value.shape)
        weight = jnp.broadcast_to(_counted(trace[name]) / fn.variance, value.shape)
        value = jnp.where(weight > 0, value, mean)
        if jnp.iscomplexobj(value):
            parts += [(value.real, mean.real, 2 * weight), (value.imag, mean.imag, 2 * weight)]
        else:
            parts.append((value, mean, weight))
    data, means, weights = zip(*parts, strict=True)
    return tuple(jnp.concatenate([x.ravel() for x in xs]) for xs in (data, means, weights))  # pyright: ignore[reportReturnType]


def _counted(message: Mapping[str, Any]) -> Array:
    """How often each entry of an observed site counts: its scale, and 0 where it is masked."""
    fn, scale = message["fn"], message["scale"]
    counted = _over_event(1.0 if scale is None else scale, fn)
    while hasattr(fn, "base_dist"):
        mask = getattr(fn, "_mask", None)  # of a MaskedDistribution, which shows it nowhere else
        if mask is not None:
            counted = counted * _over_event(mask, fn)
        fn = fn.base_dist
    return counted


def _over_event(value: Any, fn: Any) -> Array:
    """Numbers per batch entry, alike for all that one event holds."""
    array = jnp.asarray(value, float)
    return array.reshape(*array.shape, *[1] * len(fn.event_shape))
