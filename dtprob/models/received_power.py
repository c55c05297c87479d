"""Received power over traced paths: RSRP and coverage maps, where phases are lost and the level is arbitrary.

The phases of paths are taken as independent and uniform, as positions known worse than a fraction of a wavelength
make them. Then the power of a narrow band has mean P = sum_p |a_p|^2 and variance P^2 - sum_p |a_p|^4, so a link
with one strong path fades little and one with many fades much. What a receiver averages over (bandwidth, time, the
places where it looks) counts as so many independent samples.
"""

from __future__ import annotations

from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax.scipy.special import digamma, polygamma
from jaxtyping import Array, Float

from dtprob.errors import InputError
from dtprob.models.declaration import model
from dtprob.models.scene import AXES, TRACED, Materials, site, traced_gain
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.slab import Law

POWER_AXES: Final = ("link", "rx_antenna", "tx_antenna")
_AXES: Final = {
    **{name: AXES[name] for name in TRACED},
    "path_power": ("link", "path"),
    "mean_power": ("link",),
    "fading_deviation": ("link",),
}
_LEVEL_SPREAD: Final = 30 * np.log(10) / 10
_SMOOTHEST: Final = 1e-4
"""Least share of the power that fades: even a single path has weak ones beside it that no tracer finds."""


@model(axes=_AXES, cluster="link")
def received_power(
    paths: PathSet,
    *,
    noise_power: Any = None,
    materials: Materials = "per_material",
    law: Law = "slab",
    power: Float[Array, "link rx_antenna tx_antenna"] | None = None,
) -> jax.Array:
    """Power at the receivers of a ray-traced scene whose materials, level and fading are unknown.

    Sites on the way: `path_power` |a_p|^2, `mean_power` its sum times the level plus noise, `fading_deviation` that of
    the link's logarithm of power, which is close to that of Gamma(k, P / k), k = looks P^2 / (P^2 - sum |a_p|^4), and
    is modelled as normal of the same mean and variance; the instrument adds a spread of its own.

    Args:
        paths: propagation paths of each link.
        noise_power: that the receiver reports with the signal, in the units of `power`, scalar or (link,); 0 where absent.
        materials: which permittivities and conductivities are unknown, as for `ray_traced_channel`.
        law: "slab" (finite thickness) or "half_space".
        power: the measurement, linear, positive; its level is arbitrary within tens of dB. Antennas are taken to fade
            independently: average those that stand close.

    Returns:
        The mean power, (link,).

    Raises:
        InputError: powers of another number of links.

    Source: moments of a sum of phasors with independent uniform phases, e.g. P. Beckmann, Probability in
    Communication Engineering (1967), ch. 4.
    """
    links = paths.delay.shape[0]
    shape = (links, 1, 1) if power is None else power.shape
    if len(shape) != len(POWER_AXES) or shape[0] != links:
        expected = f"shape ({links}, rx_antenna, tx_antenna)"
        raise InputError("power", expected, str(tuple(shape)), "Give one path-set link per measured link")
    gain = traced_gain(paths, materials, law)
    each = site("path_power", jnp.real(gain) ** 2 + jnp.imag(gain) ** 2)
    level: Any = numpyro.sample("level_offset", dist.Normal(0.0, _LEVEL_SPREAD))
    looks: Any = numpyro.sample("looks", dist.LogNormal(np.log(4.0), 1.0))
    spread: Any = numpyro.sample("measurement_spread", dist.LogNormal(np.log(0.2), 1.0))
    total = jnp.sum(each, axis=1)
    noise = jnp.zeros(links) if noise_power is None else jnp.broadcast_to(noise_power, (links,))
    mean = site("mean_power", jnp.exp(level) * total + noise)
    fading = 1.0 - jnp.sum(each**2, axis=1) / jnp.where(total > 0, total, 1.0) ** 2
    order = looks / jnp.maximum(fading, _SMOOTHEST)
    deviation = site("fading_deviation", jnp.sqrt(polygamma(1, order)))
    location = (jnp.log(mean) + digamma(order) - jnp.log(order))[:, None, None]
    variance = (deviation**2)[:, None, None] + spread**2
    with (
        numpyro.plate("link", shape[0], dim=-3),
        numpyro.plate("rx_antenna", shape[1], dim=-2),
        numpyro.plate("tx_antenna", shape[2], dim=-1),
    ):
        numpyro.sample("power", dist.LogNormal(location, jnp.sqrt(variance)), obs=power)
    return mean


def link_power(data: Any) -> dict[str, Any]:
    """Received powers as arguments of the model: the mean over the antennas of a link, which fade together.

    Args:
        data: `dtprob.data.PowerData`.

    Raises:
        InputError: a power of zero, which no level explains.
    """
    empty = np.argwhere(data.power <= 0)
    if len(empty):
        where = ", ".join(map(str, empty[0].tolist()))
        remedy = "Leave out links without a signal, or give the receiver's noise floor as their power"
        raise InputError("power", "positive powers", f"0 at [{where}]", remedy)
    return {**data.arrays(), "power": data.power.mean(axis=(1, 2), keepdims=True)}
