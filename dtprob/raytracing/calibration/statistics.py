"""What a calibration needs to know of measured channels, computed once.

With b_p the response of path p over antennas and subcarriers at unit gain, a channel is h = sum_p c_p b_p plus white
noise. Its likelihood depends on h through B^H h and |h|^2 only, and B^H B is a product of three small matrices, entry
by entry. For the scheme that fits powers, the inner products of h with all combinations of a predicted delay, a
direction of arrival and a direction of departure are kept as their sums against the model's.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Complex, Float

from dtprob.data.tones import check_tones
from dtprob.errors import InputError
from dtprob.raytracing.field import frequency_response, steering
from dtprob.raytracing.paths import PathSet


class PowerStatistics(NamedTuple):
    """Sums over all combinations (delay, arrival, departure) of the paths of a link.

    With M_n the measured power of a combination in snapshot n, |<h, v>|^2 over the squared number of entries, and
    T_p that of path p at unit gain, the model's power is sum_p |c_p|^2 T_p.

    Attributes:
        normal: sum of T_p T_q.
        right: sum of T_p times the mean of M_n over snapshots.
        square: sum of the mean of M_n^2.
    """

    normal: Float[Array, "link path path"]
    right: Float[Array, "link path"]
    square: Float[Array, " link"]


class Statistics(eqx.Module):
    """Sufficient statistics of channels against the paths of a twin.

    Attributes:
        gram: b_p^H b_q; 0 where a path is missing.
        product: b_p^H h; likewise.
        energy: |h|^2.
        power: for the scheme that fits powers; None where it was not asked for.
        size: number of entries of h, (antennas, antennas and subcarriers multiplied).
    """

    gram: Complex[Array, "link path path"]
    product: Complex[Array, "link snapshot path"]
    energy: Float[Array, "link snapshot"]
    power: PowerStatistics | None
    size: int = eqx.field(static=True)


class _Responses(NamedTuple):
    """Responses of the paths of all links; 0 where a path is missing."""

    rx: Complex[Array, "link path rx_antenna"]
    tx: Complex[Array, "link path tx_antenna"]
    tone: Complex[Array, "link path subcarrier"]


def project(
    paths: PathSet,
    subcarrier_frequency: Float[Array, " subcarrier"],
    channel: Complex[Array, "link snapshot rx_antenna tx_antenna subcarrier"],
    *,
    rx_array: Float[Array, "rx_antenna 3"] | None = None,
    tx_array: Float[Array, "tx_antenna 3"] | None = None,
    powers: bool = True,
) -> Statistics:
    """The statistics of measured channels.

    Args:
        paths: of the twin, for the links measured.
        subcarrier_frequency: Hz from the carrier.
        channel: the measurement.
        rx_array: element positions in m from the array's centre; one element at the centre when None.
        tx_array: likewise.
        powers: whether to keep what the scheme "uniform" needs, whose cost grows with the cube of the number of paths.

    Raises:
        InputError: the channel has another shape, or holds NaN or infinity; frequencies that count from zero, or not in Hz.
    """
    if not isinstance(subcarrier_frequency, Tracer):
        check_tones(np.asarray(subcarrier_frequency), paths.frequency)
    responses = _responses(paths, subcarrier_frequency, rx_array, tx_array)
    _check_shape(paths, responses, channel)
    if not isinstance(channel, Tracer) and not np.all(np.isfinite(np.asarray(channel))):
        remedy = "Leave out snapshots that were not measured"
        raise InputError("channel", "finite values", "NaN or infinity", remedy)
    return _project(responses, jnp.asarray(channel), powers)


def _check_shape(paths: PathSet, responses: _Responses, channel: Array) -> None:
    """Compare a channel's axes, one by one, with what says how long they are."""
    if channel.ndim != 5:
        expected = "axes (link, snapshot, rx_antenna, tx_antenna, subcarrier)"
        raise InputError(
            "channel", expected, f"shape {channel.shape}", "Give all five, of length 1 if need be"
        )
    declared = {
        "link": (0, paths.n_link, "the path set"),
        "rx_antenna": (2, responses.rx.shape[2], "rx_array"),
        "tx_antenna": (3, responses.tx.shape[2], "tx_array"),
        "subcarrier": (4, responses.tone.shape[2], "subcarrier_frequency"),
    }
    for name, (axis, size, source) in declared.items():
        if channel.shape[axis] != size:
            expected, got = f"the {size} of {source}", str(channel.shape[axis])
            raise InputError(f"channel, axis {name}", expected, got, f"Let {source} describe the measurement")


def _responses(
    paths: PathSet,
    subcarrier_frequency: Float[Array, " subcarrier"],
    rx_array: Float[Array, "rx_antenna 3"] | None,
    tx_array: Float[Array, "tx_antenna 3"] | None,
) -> _Responses:
    centre = jnp.zeros((1, 3))
    rx = steering(centre if rx_array is None else jnp.asarray(rx_array), paths.arrival, paths.frequency, -1.0)
    tx = steering(
        centre if tx_array is None else jnp.asarray(tx_array), paths.departure, paths.frequency, 1.0
    )
    tone = frequency_response(paths, jnp.asarray(subcarrier_frequency))
    return _Responses(rx, tx, jnp.where(paths.mask[..., None], tone, 0))


@eqx.filter_jit
def _project(responses: _Responses, channel: Array, powers: bool) -> Statistics:
    gram = _inner(responses.rx) * _inner(responses.tx) * _inner(responses.tone)
    product = lax.map(lambda link: _matched(*link), (responses, channel))
    square = jnp.real(channel) ** 2 + jnp.imag(channel) ** 2
    energy = jnp.sum(square, axis=(2, 3, 4), dtype=jnp.real(product).dtype)
    size = int(np.prod(channel.shape[2:]))
    return Statistics(gram, product, energy, _power_statistics(responses, channel) if powers else None, size)


def _inner(response: Complex[Array, "link path entry"]) -> Complex[Array, "link path path"]:
    return jnp.einsum("lpa,lqa->lpq", jnp.conj(response), response)


def _matched(
    responses: _Responses, channel: Complex[Array, "snapshot rx_antenna tx_antenna subcarrier"]
) -> Complex[Array, "snapshot path"]:
    """b_p^H h of one link, snapshot by snapshot."""
    rx, tx, tone = (jnp.conj(part) for part in responses)

    def snapshot(h: Array) -> Array:
        at_delay = jnp.einsum("rtk,pk->prt", h, tone)
        return jnp.einsum("pr,pr->p", jnp.einsum("prt,pt->pr", at_delay, tx), rx)

    return lax.map(snapshot, channel)


def _power_statistics(responses: _Responses, channel: Array) -> PowerStatistics:
    size = np.prod(channel.shape[2:])
    here = jnp.real(responses.tone[..., 0]) ** 2 + jnp.imag(responses.tone[..., 0]) ** 2
    shares = [
        jnp.abs(_inner(part)) ** 2 * here[:, :, None] * here[:, None] / part.shape[2] ** 2
        for part in (responses.tone, responses.rx, responses.tx)
    ]
    normal = jnp.prod(jnp.stack([jnp.einsum("lpi,lqi->lpq", share, share) for share in shares]), axis=0)

    def snapshot(link: _Responses, h: Array) -> Array:
        beams = jnp.einsum("rtk,ik->irt", h, jnp.conj(link.tone))
        beams = jnp.einsum("irt,jr->ijt", beams, jnp.conj(link.rx))
        beams = jnp.einsum("ijt,kt->ijk", beams, jnp.conj(link.tx)) / size
        return jnp.real(beams) ** 2 + jnp.imag(beams) ** 2

    def one(item: tuple[_Responses, Array, tuple[Array, ...], Array]) -> tuple[Array, Array]:
        link, h, share, exists = item
        # responses to arrivals and departures are there for missing paths too
        weight = exists[:, None, None] * exists[None, :, None] * exists[None, None, :]

        def add(sums: tuple[Array, Array], each: Array) -> tuple[tuple[Array, Array], None]:
            power = weight * snapshot(link, each)
            return (sums[0] + power, sums[1] + jnp.sum(power**2)), None

        start = jnp.zeros(weight.shape), jnp.zeros(())
        (total, square), _ = lax.scan(add, start, h)
        right = jnp.einsum("pi,pj,pk,ijk->p", *share, total)
        return right / h.shape[0], square / h.shape[0]

    right, square = lax.map(one, (responses, channel, tuple(shares), here))
    return PowerStatistics(normal, right, square)
