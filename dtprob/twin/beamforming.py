"""Beams chosen from a twin, and what they gather on the real channel."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from dtprob.raytracing.field import steering
from dtprob.raytracing.paths import PathSet


class Beams(NamedTuple):
    """A pair of beams for each link, of unit norm.

    Attributes:
        rx: the receiver's output is sum_r conj(rx_r) h_r.
        tx: what the transmitter's antennas send.
    """

    rx: Complex[Array, "link rx_antenna"]
    tx: Complex[Array, "link tx_antenna"]


def statistical_beams(
    paths: PathSet,
    gain: Complex[Array, "link path"],
    rx_array: Float[Array, "rx_antenna 3"],
    tx_array: Float[Array, "tx_antenna 3"],
) -> Beams:
    """The beams that gather most on average when the phases of the paths are unknown.

    They are the principal eigenvectors of the arrays' covariances, sum_p |a_p|^2 v_p v_p^H.

    Args:
        paths: of the twin.
        gain: a_p of every path, from `path_gain`.
        rx_array: element positions in m from the array's centre.
        tx_array: likewise.
    """
    weight = jnp.real(gain) ** 2 + jnp.imag(gain) ** 2
    rx = steering(rx_array, paths.arrival, paths.frequency, -1.0)
    tx = jnp.conj(steering(tx_array, paths.departure, paths.frequency, 1.0))
    return Beams(_principal(weight, rx), _principal(weight, tx))


def gathered(
    beams: Beams, channel: Complex[Array, "link snapshot rx_antenna tx_antenna subcarrier"]
) -> Float[Array, "link snapshot"]:
    """Power through a pair of beams as a share of what the best pair of each subcarrier gathers, between 0 and 1.

    Args:
        beams: of each link.
        channel: the real one.
    """
    through = jnp.einsum("lr,lsrtk,lt->lsk", jnp.conj(beams.rx), channel, beams.tx)
    matrices = jnp.moveaxis(channel, -1, 2)
    best = jnp.linalg.norm(matrices, ord=2, axis=(-2, -1)) ** 2
    return jnp.sum(jnp.abs(through) ** 2, axis=-1) / jnp.sum(best, axis=-1)


def _principal(
    weight: Float[Array, "link path"], response: Complex[Array, "link path antenna"]
) -> Complex[Array, "link antenna"]:
    covariance = jnp.einsum("lp,lpa,lpb->lab", weight, response, jnp.conj(response))
    scale = jnp.maximum(jnp.trace(covariance, axis1=1, axis2=2), jnp.finfo(weight.dtype).tiny)
    return jnp.linalg.eigh(covariance / scale[:, None, None])[1][..., -1]
