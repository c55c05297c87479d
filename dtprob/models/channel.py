"""Ray-traced channels as generative models: without phase errors, and with a von Mises error on each path.

Both compute h(f_k) = sum_p a_p exp(-j 2 pi (f_c + f_k) tau_p) times the array responses, from a path set that
was traced once, and name every physical intermediate as a site, so that effects can act there. Time convention
e^{+j w t}.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Complex, Float

from dtprob.errors import check_choice
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
from dtprob.raytracing import field
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.slab import Law

type Phase = Literal["coherent", "per_packet"]


@model(axes=AXES, cluster="link")
def ray_traced_channel(
    paths: PathSet,
    subcarrier_frequency: Float[Array, " subcarrier"],
    *,
    rx_array: Float[Array, "rx_antenna 3"] | None = None,
    tx_array: Float[Array, "tx_antenna 3"] | None = None,
    noise_power: Any = None,
    snapshot_time: Float[Array, " snapshot"] | None = None,
    phase: Phase = "coherent",
    materials: Materials = "per_material",
    law: Law = "slab",
    channel: Complex[Array, "link snapshot rx_antenna tx_antenna subcarrier"] | None = None,
) -> jax.Array:
    """Channel of a ray-traced scene whose materials and noise level are unknown; phases are as traced.

    Args:
        paths: propagation paths of each link.
        subcarrier_frequency: Hz from the carrier.
        rx_array: element positions in m from the array's centre; one element at the centre where absent.
        tx_array: likewise.
        noise_power: E |noise|^2 per entry of the channel, scalar or (link,), known to about 10%; unknown where absent.
        snapshot_time: s; only effects that vary over time look at it.
        phase: "per_packet" gives every link and snapshot an unknown phase of its own.
        materials: which permittivities and conductivities are unknown: one pair per material class, per object, one
            shared by all objects, or none.
        law: "slab" (finite thickness, as Sionna traces) or "half_space".
        channel: the measurement.

    Returns:
        The noiseless channel.
    """
    shape = channel_shape(
        paths,
        subcarrier_frequency,
        rx_array=rx_array,
        tx_array=tx_array,
        snapshot_time=snapshot_time,
        channel=channel,
    )
    error = jnp.zeros((1, 1, 1))
    return _channel(
        paths,
        subcarrier_frequency,
        rx_array=rx_array,
        tx_array=tx_array,
        noise_power=noise_power,
        phase=phase,
        materials=materials,
        law=law,
        channel=channel,
        shape=shape,
        phase_error=error,
    )


@model(axes=AXES, cluster="link")
def phase_error_channel(
    paths: PathSet,
    subcarrier_frequency: Float[Array, " subcarrier"],
    *,
    rx_array: Float[Array, "rx_antenna 3"] | None = None,
    tx_array: Float[Array, "tx_antenna 3"] | None = None,
    noise_power: Any = None,
    snapshot_time: Float[Array, " snapshot"] | None = None,
    materials: Materials = "per_material",
    law: Law = "slab",
    channel: Complex[Array, "link snapshot rx_antenna tx_antenna subcarrier"] | None = None,
) -> jax.Array:
    """Channel of a ray-traced scene with an independent phase error on every path of every snapshot.

    z_p ~ VM(0, k0), k0 unknown; the other arguments are those of `ray_traced_channel`. Source: Ruah et al.,
    arXiv 2312.12625, eq. of the phase error channel model.
    """
    shape = channel_shape(
        paths,
        subcarrier_frequency,
        rx_array=rx_array,
        tx_array=tx_array,
        snapshot_time=snapshot_time,
        channel=channel,
    )
    concentration = numpyro.sample("phase_concentration", dist.LogNormal(0.0, 1.5))
    with (
        numpyro.plate("link", shape[0], dim=-3),
        numpyro.plate("snapshot", shape[1], dim=-2),
        numpyro.plate("path", paths.delay.shape[1], dim=-1),
    ):
        error = numpyro.sample("phase_error", dist.VonMises(0.0, concentration))
    return _channel(
        paths,
        subcarrier_frequency,
        rx_array=rx_array,
        tx_array=tx_array,
        noise_power=noise_power,
        phase="coherent",
        materials=materials,
        law=law,
        channel=channel,
        shape=shape,
        phase_error=error,
    )


def _channel(
    paths: PathSet,
    subcarrier_frequency: jax.Array,
    *,
    rx_array: jax.Array | None,
    tx_array: jax.Array | None,
    noise_power: Any,
    phase: Phase,
    materials: Materials,
    law: Law,
    channel: jax.Array | None,
    shape: tuple[int, int, int, int, int],
    phase_error: Any,
) -> jax.Array:
    gain = traced_gain(paths, materials, law)
    delay = site("path_delay", paths.delay)
    departure = site("departure", paths.departure)
    arrival = site("arrival", paths.arrival)
    path_phase = site("path_phase", phase_error + _packet_phase(phase, shape))
    tx_response = site("tx_response", array_response(tx_array, departure, paths.frequency, 1.0))
    rx_response = site("rx_response", array_response(rx_array, arrival, paths.frequency, -1.0))
    frequency_response = site("frequency_response", jnp.ones(shape[4], jnp.result_type(gain)))
    response = site("path_response", field.frequency_response(paths, subcarrier_frequency, delay))
    response = response * frequency_response
    phasor = jax.lax.complex(jnp.cos(path_phase), jnp.sin(path_phase))
    noiseless = field.synthesize(gain, response, rx_response, tx_response, phasor)
    noiseless = site("noiseless_channel", noiseless)
    noise = site("noise_power", unknown_noise_power(noise_power, paths))
    observe(noiseless, noise, shape, channel)
    return noiseless


def _packet_phase(phase: Phase, shape: tuple[int, int, int, int, int]) -> Any:
    """A phase per link and snapshot, (link, snapshot, 1) rad, or zero where packets are coherent."""
    check_choice("phase", phase, get_args(Phase.__value__))
    if phase == "coherent":
        return jnp.zeros((1, 1, 1))
    with numpyro.plate("link", shape[0], dim=-2), numpyro.plate("snapshot", shape[1], dim=-1):
        return jnp.asarray(numpyro.sample("packet_phase", unknown_phase()))[..., None]
