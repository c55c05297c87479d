"""Power over the delay of a ray-traced scene, as ultra-wideband radios report it: phases of paths are lost.

Places known to a centimetre leave the phases of paths at some GHz unknown, so a twin that sums traced paths coherently
blames on everything else what it says wrongly there. Here the phase of each path is independent and uniform: the
amplitude of one delay tap is a sum of many phasors, and its power is exponential about the sum of the paths' powers.
Beside the traced paths each link has the tail of waves that no tracer resolves, of exponential decay behind the first
path. A Gamma distribution of unknown shape in place of the exponential one says how well that holds: 1 where it does.
"""

from __future__ import annotations

from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Float

from dtprob.data.kinds import ChannelData
from dtprob.errors import InputError
from dtprob.models.declaration import model
from dtprob.models.scene import AXES, TRACED, Materials, site, traced_gain
from dtprob.models.ultra_wideband.receiver import (
    GAIN_SPREAD,
    RANGING_SPREAD,
    RANGING_TAIL,
    Receiver,
    gain_law,
    ranging_offset,
    unknown_levels,
    unknown_pulse,
)
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.phasor import phasor
from dtprob.raytracing.slab import Law

_AXES: Final = {
    **{name: AXES[name] for name in (*TRACED, "path_delay", "departure", "arrival")},
    "path_power": ("link", "path"),
    "receiver_delay": ("link",),
    "receiver_gain": ("link",),
    "tail": ("link", "tap"),
    "tap_power": ("link", "tap"),
}
_EARLY: Final = 2.0
"""Taps before the time origin: what is early by an error of ranging does not wrap around."""
_LEAST: Final = 1e-9
"""Least power of a tap, of its link's mean: a logarithm of zero says nothing."""
_UNEVEN: Final = 1e-3
"""Share of the spacing by which subcarriers may be off a common grid."""


@model(axes=_AXES, cluster="link")
def ultra_wideband_profile(
    paths: PathSet,
    subcarrier_frequency: Float[Array, " subcarrier"],
    tap_delay: Float[Array, " tap"],
    *,
    tap_noise: Float[Array, " link"] | None = None,
    materials: Materials = "known",
    law: Law = "slab",
    tail_spread_db: float = 0.0,
    power: Float[Array, "link tap"] | None = None,
) -> jax.Array:
    """Mean power of each delay tap of a ray-traced scene, its time origin from two-way ranging.

    Unknown: the response of pulse and filters, the radiated power, the saturated level and for each link a gain (as for
    `ultra_wideband_channel`), and its error of ranging (0.6 ns, heavy tails, about a common offset); the power of the tail
    (against free space over the first path), of each link where it has a spread, and its decay; a floor under all taps, of
    the link's mean, as side lobes of the receiver's correlation make; the shape of the taps' distribution; materials where
    asked for.

    Args:
        paths: propagation paths of each link.
        subcarrier_frequency: Hz from the carrier.
        tap_delay: s, from `delay_profile`.
        tap_noise: W, mean power of the noise in each tap of a link; 0 where absent.
        materials: which permittivities and conductivities are unknown, as for `ray_traced_channel`.
        law: "slab" (finite thickness) or "half_space".
        tail_spread_db: standard deviation, dB, of a link's tail about what all have in common; 0 where all are alike.
        power: the measurement, W, from `delay_profile`.

    Returns:
        The mean power, (link, tap).

    Raises:
        InputError: powers of another shape, or a negative spread.

    Source: exponential tails and powers of taps, A. Saleh, R. Valenzuela, IEEE JSAC 5 (1987); dense tail, A. Richter,
    thesis, TU Ilmenau (2005), 2.5.
    """
    shape = paths.n_link, tap_delay.shape[0]
    if power is not None and power.shape != shape:
        remedy = "Give one path-set link per measured link, and powers from delay_profile"
        raise InputError("power", f"shape {shape} as (link, tap)", f"{tuple(power.shape)}", remedy)
    if tail_spread_db < 0:
        raise InputError("tail_spread_db", "0 dB or more", f"{tail_spread_db}", "Give the standard deviation")
    gain = traced_gain(paths, materials, law)
    each = site("path_power", jnp.real(gain) ** 2 + jnp.imag(gain) ** 2)
    delay = site("path_delay", paths.delay)
    site("departure", paths.departure)
    site("arrival", paths.arrival)
    receiver = _unknown_receiver(shape[0])
    late = site("receiver_delay", receiver.delay)
    pulse = unknown_pulse(subcarrier_frequency)
    traced = _over_taps(each, delay + late[:, None], pulse, subcarrier_frequency, tap_delay)
    own = _unknown_strength(shape[0], tail_spread_db)[:, None]
    room = traced + site("tail", own * _unknown_tail(paths, delay, late, tap_delay))
    floor: Any = numpyro.sample("floor", dist.LogNormal(np.log(1e-3), 1.5))
    room = room + floor * jnp.mean(room, axis=1, keepdims=True)
    amplitude = site("receiver_gain", gain_law(jnp.sum(room, axis=1), receiver))
    noise = jnp.zeros(shape[0]) if tap_noise is None else tap_noise
    mean = site("tap_power", amplitude[:, None] ** 2 * room + noise[:, None])
    form: Any = numpyro.sample("shape", dist.LogNormal(0.0, 0.5))
    with numpyro.plate("link", shape[0], dim=-2), numpyro.plate("tap", shape[1], dim=-1):
        rate = jnp.exp(jnp.log(form) - jnp.log(mean))  # whose derivatives do not overflow at some picowatts
        numpyro.sample("power", dist.Gamma(form, rate), obs=power)
    return mean


def delay_profile(data: ChannelData) -> dict[str, Any]:
    """Powers over the delay as arguments of the model: the mean over snapshots and antennas of each tap.

    Taps are as far apart as the band resolves, an inverse bandwidth, over one period of the subcarriers' grid, from two
    taps before the time origin.

    Args:
        data: the measured channel, over subcarriers of one spacing; single ones may be absent.

    Raises:
        InputError: subcarriers that lie on no common grid.
    """
    frequency = np.asarray(data.subcarrier_frequency)
    taps, spacing = _grid(frequency)
    tap_delay = (np.arange(taps) - _EARLY) / (taps * spacing)
    turned = np.exp(2j * np.pi * np.outer(tap_delay, frequency)) / len(frequency)
    power = np.mean(np.abs(data.channel @ turned.T) ** 2, axis=(1, 2, 3))
    power = np.maximum(power, _LEAST * power.mean(axis=1, keepdims=True))
    found: dict[str, Any] = {"subcarrier_frequency": frequency, "tap_delay": tap_delay, "power": power}
    if data.noise_power is not None:
        found["tap_noise"] = np.broadcast_to(data.noise_power, len(power)) / len(frequency)
    return found


def _grid(frequency: Float[np.ndarray, " subcarrier"]) -> tuple[int, float]:
    """Number of places, taken or not, and spacing, Hz, of the grid that the subcarriers lie on."""
    spacing = float(np.diff(np.sort(frequency)).min(initial=np.inf))
    place = (frequency - frequency.min()) / spacing if 0 < spacing < np.inf else np.full(1, 0.5)
    if np.any(np.abs(place - np.round(place)) > _UNEVEN):
        expected, remedy = "two subcarriers or more, of one spacing", "Choose subcarriers of a common grid"
        raise InputError("subcarrier_frequency", expected, f"{len(frequency)} on no grid", remedy)
    return round(place.max()) + 1, spacing


def _unknown_receiver(links: int) -> Receiver:
    offset, levels = ranging_offset(), unknown_levels()
    with numpyro.plate("link", links, dim=-1):
        delay: Any = numpyro.sample("link_delay", dist.StudentT(RANGING_TAIL, 0.0, 1.0))
        log_gain: Any = numpyro.sample("link_gain", dist.Normal(0.0, 1.0))
    return Receiver(offset + RANGING_SPREAD * delay, GAIN_SPREAD * log_gain, *levels)


def _unknown_strength(links: int, spread_db: float) -> Float[Array, " link"]:
    """By which factor the power of each link's tail departs from what all have in common."""
    if spread_db == 0.0:
        return jnp.ones(links)
    with numpyro.plate("link", links, dim=-1):
        strength: Any = numpyro.sample("tail_strength", dist.Normal(0.0, 1.0))
    return jnp.exp(spread_db * np.log(10.0) / 10.0 * strength)


def _over_taps(
    power: jax.Array,
    delay: jax.Array,
    pulse: jax.Array,
    subcarrier_frequency: jax.Array,
    tap_delay: jax.Array,
) -> Float[Array, "link tap"]:
    """Powers of paths, each spread over the taps as the pulse is: its power is the transform of its autocorrelation."""
    taps, spacing = tap_delay.shape[0], 1.0 / (tap_delay.shape[0] * (tap_delay[1] - tap_delay[0]))
    index = jnp.round((subcarrier_frequency - jnp.min(subcarrier_frequency)) / spacing).astype(int)
    spectrum = jnp.zeros(taps, pulse.dtype).at[index].set(pulse / subcarrier_frequency.shape[0])
    lagged = jnp.fft.ifft(jnp.abs(jnp.fft.fft(spectrum, 2 * taps)) ** 2)[:taps].at[1:].multiply(2.0)
    lag = spacing * jnp.arange(taps)
    summed = jnp.einsum("lp,lpm->lm", power, phasor(-delay[..., None] * lag))
    found = jnp.real(jnp.einsum("lm,tm->lt", summed * lagged, phasor(tap_delay[:, None] * lag)))
    return jnp.maximum(found, _LEAST * jnp.max(found, axis=1, keepdims=True))


def _unknown_tail(
    paths: PathSet, delay: jax.Array, late: jax.Array, tap_delay: jax.Array
) -> Float[Array, "link tap"]:
    """Waves that are not resolved: exponential behind the first path, its rise one tap long and flat at its foot.

    With a corner there the density had one in each link's delay for each tap, and modes sat in these.
    """
    share: Any = numpyro.sample("tail_share", dist.LogNormal(np.log(0.1), 1.5))
    decay: Any = numpyro.sample("tail_decay", dist.LogNormal(np.log(10e-9), 0.7))
    first = jnp.min(jnp.where(paths.mask, delay, jnp.inf), axis=1)
    free = (1.0 / (4.0 * jnp.pi * paths.frequency * first)) ** 2
    step = tap_delay[1] - tap_delay[0]
    behind = jnp.maximum(tap_delay - (first + late)[:, None], 0.0)
    form = jnp.exp(-behind / decay) * -jnp.expm1(-((behind / step) ** 2)) * (step / decay)
    return share * free[:, None] * form
