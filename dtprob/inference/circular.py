"""Angles: wrapping, and the summaries that make sense for them.

Source: Mardia and Jupp, Directional Statistics (2000), chapter 2.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

TURN = 2.0 * np.pi


def wrap(angle: Float[Array, " *shape"]) -> Float[Array, " *shape"]:
    """The same angle in (-pi, pi], with derivative one.

    Args:
        angle: any angle, rad.
    """
    wrapped = angle - TURN * jnp.ceil((angle - jnp.pi) / TURN)
    rounded = jnp.clip(wrapped, -jnp.pi, jnp.pi)
    return angle + jax.lax.stop_gradient(jnp.where(rounded > -jnp.pi, rounded, jnp.pi) - angle)


def mean_direction(angle: Float[np.ndarray, " sample *event"]) -> Float[np.ndarray, " *event"]:
    """Direction of the mean of exp(j angle) over the first axis, rad in (-pi, pi]."""
    return np.angle(np.mean(np.exp(1j * angle), axis=0))


def resultant_length(angle: Float[np.ndarray, " sample *event"]) -> Float[np.ndarray, " *event"]:
    """Length of the mean of exp(j angle) over the first axis: 1 for one value, 0 for a uniform spread."""
    return np.abs(np.mean(np.exp(1j * angle), axis=0))


def arc_interval(
    angle: Float[np.ndarray, " sample *event"], probability: float = 0.9
) -> Float[np.ndarray, " 2 *event"]:
    """The shortest arc that holds a share of the angles.

    Args:
        angle: rad, samples on the first axis.
        probability: the share, between 0 and 1.

    Returns:
        start and end of the arc, rad in (-pi, pi]; it runs counter-clockwise from start to end, so start is
        above end where the arc crosses pi.
    """
    ordered = np.sort(np.mod(angle, TURN), axis=0)
    count = ordered.shape[0]
    inside = min(max(int(np.ceil(probability * count)), 1), count)
    ends = np.concatenate([ordered, ordered + TURN])[inside - 1 : inside - 1 + count]
    best = np.argmin(ends - ordered, axis=0)[None]
    arc = np.concatenate([np.take_along_axis(ordered, best, 0), np.take_along_axis(ends, best, 0)])
    return np.angle(np.exp(1j * arc))
