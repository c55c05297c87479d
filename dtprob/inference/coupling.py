"""Which angles of a model act on the same data: found from mixed derivatives, axis by axis."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PRNGKeyArray

from dtprob.inference.modes import objective_value
from dtprob.inference.target import Inputs, Target

_SPLITS = 6


def angle_sites(target: Target) -> list[str]:
    """The circular latent sites, in the order of the target's angles."""
    return [name for name, place in target.coordinates.items() if place.is_circular]


def separating_axes(target: Target, inputs: Inputs, key: PRNGKeyArray) -> list[str]:
    """Axes that all circular sites have, along which entries of different index are never coupled.

    Args:
        target: a target with circular sites.
        inputs: its arrays.
        key: typed JAX key, for the points at which the model is looked at.
    """
    return [axis for axis in _common_axes(target) if _separates(target, inputs, axis, key)]


def _common_axes(target: Target) -> list[str]:
    sites = [target.declaration.sites[name] for name in angle_sites(target)]
    sizes = [dict(zip(site.axes, site.shape, strict=True)) for site in sites]
    return [axis for axis, size in sizes[0].items() if all(other.get(axis) == size for other in sizes)]


def _separates(target: Target, inputs: Inputs, axis: str, key: PRNGKeyArray) -> bool:
    """No mixed derivatives between the halves of random splits of the axis."""
    labels: list[np.ndarray] = []
    for name in angle_sites(target):
        site = target.declaration.sites[name]
        labels.append(np.indices(site.shape)[site.axes.index(axis)].ravel())
    label = np.concatenate(labels)
    count = int(label.max()) + 1
    if count == 1:
        return False
    halves = np.random.default_rng(0).permuted(np.tile(np.arange(count) % 2 == 0, (_SPLITS, 1)), axis=1)
    cross, scale = target.compiled(_cross_derivatives)(jnp.asarray(halves[:, label]), key, inputs)
    return bool(cross <= 100 * float(jnp.finfo(cross.dtype).eps) ** 0.5 * scale)


def _cross_derivatives(
    target: Target, halves: Bool[Array, "split angle"], key: PRNGKeyArray, inputs: Inputs
) -> tuple[Array, Array]:
    """Largest response of one half's slopes to a change of the other, over splits; and the largest of any."""

    def one(half: Array, key: PRNGKeyArray) -> tuple[Array, Array]:
        point_key, direction_key = jax.random.split(key)
        point = 0.3 * jax.random.normal(point_key, (target.dimension,))
        direction = jnp.where(half, jax.random.normal(direction_key, half.shape), 0.0)
        tangent = jnp.zeros_like(point).at[target.angles].set(direction)
        slope = jax.grad(lambda u: objective_value(target, "map", u, inputs))
        product = jnp.abs(jax.jvp(slope, (point,), (tangent,))[1][target.angles])
        return jnp.max(jnp.where(half, 0.0, product)), jnp.max(product)

    cross, scale = jax.lax.map(
        lambda arguments: one(*arguments), (halves, jax.random.split(key, halves.shape[0]))
    )
    return jnp.max(cross), jnp.max(scale)
