"""Channel of a ray-traced scene as ultra-wideband radios report it: pulse, level, phase and delay unknown.

What such a radio gives is the room's response times that of the pulse and the filters, from a time origin
that the first-path detector chose, with an arbitrary phase, at a level that the chip reports and that
saturates at short range. Per link l, h_l(f_k) = g_l u_l(f_k) w(f_k) exp(j phi_l - j 2 pi f_k d_l), where u_l is the
traced field. The snapshots of a link are averages of packets that were brought to one phase, gain and delay
before (`dtprob.data.uwb_apartment`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Complex, Float

from dtprob.errors import InputError
from dtprob.models.declaration import model
from dtprob.models.scene import (
    AXES,
    Materials,
    array_response,
    channel_shape,
    observe,
    site,
    traced_gain,
    unknown_noise_power,
    unknown_phase,
)
from dtprob.models.ultra_wideband.receiver import (
    GAIN_SPREAD,
    RANGING_SPREAD,
    RANGING_TAIL,
    Receiver,
    gain_law,
    ranging_offset,
    turn,
    unknown_levels,
    unknown_pulse,
)
from dtprob.raytracing import field
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.phasor import phasor
from dtprob.raytracing.slab import Law

_AXES: Final = AXES | {"receiver_gain": ("link",), "receiver_delay": ("link",)}
_DELAY_SPREAD: Final = 0.5e-9
_LAGS: Final = np.arange(-2e-9, 14e-9, 0.1e-9)


type TimeOrigin = Literal["searched", "ranged"]
"""What is known of a link's time origin: where the data match the twin, or what two-way ranging says."""


@model(axes=_AXES, cluster="link")
def ultra_wideband_channel(
    paths: PathSet,
    subcarrier_frequency: Float[Array, " subcarrier"],
    *,
    noise_power: Any = None,
    rough_delay: Float[Array, " link"] | None = None,
    link_power: Float[Array, " link"] | None = None,
    model_error: float = 0.1,
    time_origin: TimeOrigin = "searched",
    phase: Literal["per_packet"] = "per_packet",
    materials: Materials = "per_material",
    law: Law = "slab",
    channel: Complex[Array, "link snapshot rx_antenna tx_antenna subcarrier"] | None = None,
) -> jax.Array:
    """Channel of a ray-traced scene as an ultra-wideband receiver reports it.

    Unknown: materials, the smooth response of the pulse and the filters (log gain: Legendre orders 1 to 8,
    phase: 2 to 8, over the band), the radiated power and the saturated level, and for each link a phase, a
    delay (0.5 ns around `rough_delay`) and a gain (3 dB around the law R = S x / (1 + x), x = T P / S, of reported
    level R, saturated level S, radiated power T and path gain P of the twin).

    Args:
        paths: propagation paths of each link.
        subcarrier_frequency: Hz from the carrier.
        noise_power: E |noise|^2 per entry of the channel, scalar or (link,); unknown where absent.
        rough_delay: s, of each link's time origin against the twin's; 0 where absent.
        link_power: W, mean of |channel|^2 of each measured link, from `link_power`; with `noise_power`.
        model_error: share of it by which the best twin is wrong, the same in all snapshots of a link. Ends
            rounded to 1 cm turn the paths at 4 GHz by 0.34 rad: 0.1.
        time_origin: "searched" centres each delay on `rough_delay`, which leaves the time of flight unused; "ranged"
            on an offset common to all links, with errors of 0.6 ns and heavy tails (Student's t with 3 degrees of
            freedom), as two-way ranging has: devices that are not where the twin has them then show.
        phase: "per_packet", the only one: phases of different packets cannot be compared.
        materials: which permittivities and conductivities are unknown, as in `ray_traced_channel`.
        law: "slab" (finite thickness) or "half_space".
        channel: the measurement, with |channel|^2 in W as the receiver reports the level.

    Returns:
        The noiseless channel.

    Raises:
        InputError: another `phase` or `time_origin`, or arrays that do not fit together.
    """
    if time_origin not in get_args(TimeOrigin.__value__):
        raise InputError("time_origin", "searched or ranged", repr(time_origin), "Correct the value")
    if phase != "per_packet":
        raise InputError("phase", "per_packet", repr(phase), 'Set phase = "per_packet" in [data]')
    shape = channel_shape(paths, subcarrier_frequency, channel=channel)
    room = traced_gain(paths, materials, law)
    receiver, angle = _unknown_receiver(shape[0], rough_delay, time_origin)
    noiseless = _received(paths, subcarrier_frequency, room, receiver, angle)
    noise = site("noise_power", _variance(paths, noise_power, link_power, model_error, shape[1]))
    observe(noiseless, noise, shape, channel)
    return noiseless


def rough_delay(arguments: Mapping[str, Any]) -> Float[np.ndarray, " link"]:
    """Delay of each measured link against the twin as traced, s, to about half an inverse bandwidth.

    The lag from -2 to 14 ns at which the magnitude of their correlation over the band is largest. It is the
    centre of a prior and chooses the local optimum that a fit starts in, so the data enter twice, for this
    nuisance alone.

    Args:
        arguments: of the model: `paths`, `subcarrier_frequency` and `channel`.
    """
    paths: PathSet = arguments["paths"]
    frequency = np.asarray(arguments["subcarrier_frequency"])
    measured = np.asarray(arguments["channel"]).mean(axis=(1, 2, 3))
    gain = field.path_gain(paths, paths.permittivity, paths.conductivity)
    response = field.frequency_response(paths, arguments["subcarrier_frequency"])
    twin = np.asarray(field.synthesize(gain, response))[:, 0, 0, 0]
    turned = np.exp(2j * np.pi * np.outer(_LAGS, frequency))
    match = np.abs((np.conj(twin) * measured) @ turned.T)
    return _LAGS[np.argmax(match, axis=1)]


def link_power(arguments: Mapping[str, Any]) -> Float[np.ndarray, " link"]:
    """Mean power of each measured link.

    Args:
        arguments: of the model: `channel`.
    """
    return np.mean(np.abs(np.asarray(arguments["channel"])) ** 2, axis=(1, 2, 3, 4))


def _variance(
    paths: PathSet, noise_power: Any, link_power: jax.Array | None, model_error: float, snapshots: int
) -> jax.Array:
    """Variance of one snapshot such that their mean is as uncertain as noise and model error make it."""
    if noise_power is None:
        return unknown_noise_power(None, paths)
    error = 0.0 if link_power is None else snapshots * model_error * link_power
    return jnp.broadcast_to(noise_power + error, (paths.n_link,)).reshape((-1, 1, 1, 1, 1))


def _unknown_receiver(
    links: int, rough: jax.Array | None, time_origin: TimeOrigin
) -> tuple[Receiver, jax.Array]:
    """The receiver, and the phase of each link, rad."""
    error: Any = dist.Normal(0.0, 1.0)
    around, spread = 0.0 if rough is None else rough, _DELAY_SPREAD
    if time_origin == "ranged":
        around, spread = ranging_offset(), RANGING_SPREAD
        error = dist.StudentT(RANGING_TAIL, 0.0, 1.0)
    transmitted, saturated = unknown_levels()
    with numpyro.plate("link", links, dim=-1):
        phase: Any = numpyro.sample("link_phase", unknown_phase())
        delay: Any = numpyro.sample("link_delay", error)
        log_gain: Any = numpyro.sample("link_gain", dist.Normal(0.0, 1.0))
    return Receiver(around + spread * delay, GAIN_SPREAD * log_gain, transmitted, saturated), phase


def _received(
    paths: PathSet, subcarrier_frequency: jax.Array, gain: jax.Array, receiver: Receiver, phase: jax.Array
) -> jax.Array:
    """The site `noiseless_channel` and those that lead to it from the gains of the paths."""
    delay = site("path_delay", paths.delay)
    departure = site("departure", paths.departure)
    arrival = site("arrival", paths.arrival)
    turned = jnp.broadcast_to(phase[:, None, None], (gain.shape[0], 1, gain.shape[1]))
    path_phase = site("path_phase", turned)
    tx_response = site("tx_response", array_response(None, departure, paths.frequency, 1.0))
    rx_response = site("rx_response", array_response(None, arrival, paths.frequency, -1.0))
    common = site("frequency_response", unknown_pulse(subcarrier_frequency))
    response = site("path_response", field.frequency_response(paths, subcarrier_frequency, delay))
    traced = field.synthesize(gain, response, rx_response, tx_response, turn(path_phase))
    level = jnp.mean(jnp.real(traced) ** 2 + jnp.imag(traced) ** 2, axis=(1, 2, 3, 4))
    amplitude = site("receiver_gain", gain_law(level, receiver))
    late = site("receiver_delay", receiver.delay)
    own = amplitude[:, None] * phasor(-late[:, None] * subcarrier_frequency)
    return site("noiseless_channel", traced * (own * common)[:, None, None, None, :])
