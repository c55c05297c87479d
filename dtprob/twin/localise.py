"""Where a receiver stands, from its channel and the twin's channels at candidate places."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Int

from dtprob.raytracing.calibration import Statistics


class Location(NamedTuple):
    """The places of some measurements.

    Attributes:
        candidate: index of the most probable place.
        probability: of each candidate, all equally probable beforehand.
    """

    candidate: Int[Array, " snapshot"]
    probability: Float[Array, "snapshot candidate"]


def localise(
    statistics: Statistics,
    gain: Complex[Array, "candidate path"],
    noise_power: float | Float[Array, ""],
) -> Location:
    """Place receivers among candidates by the power that each candidate's paths explain.

    The phases of paths are not trusted, as in a real twin; their strengths, delays and directions are. With c_p the
    complex amplitude of path p, taken as normal with the variance |a_p|^2 that the twin predicts, the channel is normal
    with covariance B diag(|a_p|^2) B^H + s2 I, and its density follows from B^H h, B^H B and |h|^2 alone.

    Args:
        statistics: of the measurements against each candidate's paths: candidates are its links, every one with the
            same snapshots (`dtprob.raytracing.calibration.project` of the measurement repeated for every candidate).
        gain: a_p of the paths to each candidate, from `path_gain`.
        noise_power: E |noise|^2 per entry of the channel.
    """
    root = jnp.abs(gain)
    core = jnp.eye(gain.shape[1]) + root[:, :, None] * statistics.gram * root[:, None] / noise_power
    matched = root[:, None] * statistics.product / noise_power
    solved = jnp.einsum("lpq,lsq->lsp", jnp.linalg.inv(core), matched)
    # |h|^2 / s2 and the entries' log s2 are common to all candidates
    log_density = jnp.real(jnp.sum(jnp.conj(matched) * solved, axis=-1))
    log_density -= jnp.linalg.slogdet(core)[1][:, None]
    probability = jax.nn.softmax(log_density, axis=0).T
    return Location(jnp.argmax(probability, axis=1), probability)
