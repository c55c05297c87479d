"""What models of ray-traced scenes share: axes, materials, array responses, noise, the measured site."""

from __future__ import annotations

from typing import Any, Final, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax.core import Tracer
from jaxtyping import Array, Complex, Float, Int
from numpyro.distributions import constraints, transforms

from dtprob.errors import InputError, check_choice
from dtprob.models.complex_normal import ComplexNormal
from dtprob.raytracing import field
from dtprob.raytracing.beyond import with_all
from dtprob.raytracing.paths import NONE, PathSet
from dtprob.raytracing.slab import Law

type Materials = Literal["per_material", "per_object", "hierarchical", "shared", "known"]
"""Which permittivities and conductivities are unknown; "hierarchical" gives objects their own, about their class's."""

_METAL: Final = 1e5
"""A conductivity above this, in S/m, is a metal's: all metals reflect alike, so that it says nothing of other objects."""
_CONTRAST_SPREAD: Final = 0.4
"""Standard deviation of the logarithm of a permittivity less one about the scene's."""
_CONDUCTIVITY_SPREAD: Final = 1.0
"""Standard deviation of the logarithm of a conductivity about the scene's."""

CHANNEL_AXES = ("link", "snapshot", "rx_antenna", "tx_antenna", "subcarrier")
AXES = {
    "permittivity": ("object",),
    "conductivity": ("object",),
    "thickness": ("object",),
    "path_share": ("link", "path"),
    "path_gain": ("link", "path"),
    "path_delay": ("link", "path"),
    "departure": ("link", "path", "direction"),
    "arrival": ("link", "path", "direction"),
    "path_phase": ("link", "snapshot", "path"),
    "tx_response": ("link", "path", "tx_antenna"),
    "rx_response": ("link", "path", "rx_antenna"),
    "path_response": ("link", "path", "subcarrier"),
    "frequency_response": ("subcarrier",),
    "noiseless_channel": CHANNEL_AXES,
    "noise_power": CHANNEL_AXES,
}

TRACED: Final = ("permittivity", "conductivity", "thickness", "path_share", "path_gain")
"""Sites of `traced_gain`."""


def channel_shape(
    paths: PathSet,
    subcarrier_frequency: jax.Array,
    *,
    rx_array: jax.Array | None = None,
    tx_array: jax.Array | None = None,
    snapshot_time: jax.Array | None = None,
    channel: jax.Array | None = None,
) -> tuple[int, int, int, int, int]:
    """(link, snapshot, rx_antenna, tx_antenna, subcarrier), checked against the measurement's shape."""
    expected = (
        paths.delay.shape[0],
        1 if snapshot_time is None else snapshot_time.shape[0],
        1 if rx_array is None else rx_array.shape[0],
        1 if tx_array is None else tx_array.shape[0],
        subcarrier_frequency.shape[0],
    )
    if channel is None:
        return expected
    snapshots = channel.shape[1] if snapshot_time is None and channel.ndim == 5 else expected[1]
    expected = (expected[0], snapshots, *expected[2:])
    if channel.shape != expected:
        raise InputError(
            "channel",
            f"shape {expected} as (link, snapshot, rx_antenna, tx_antenna, subcarrier)",
            f"{tuple(channel.shape)}",
            "Give one path-set link per measured link, and the arrays and subcarriers of the measurement.",
        )
    return expected


def unknown_materials(paths: PathSet, materials: Materials) -> tuple[jax.Array, jax.Array]:
    """Permittivity (relative) and conductivity (S/m) of each object, around the scene's own values.

    "shared" lies around the median over the objects that paths hit, metals aside, and is as wide as their values differ.

    Raises:
        InputError: `materials` is none of the choices.
    """
    check_choice("materials", materials, get_args(Materials.__value__))
    permittivity, conductivity = jnp.asarray(paths.permittivity), jnp.asarray(paths.conductivity)
    if materials == "known":
        return permittivity, conductivity
    if materials == "shared":
        index, nominal = jnp.zeros(permittivity.shape[0], int), _typical(paths)
    elif materials == "per_object":
        index = jnp.arange(permittivity.shape[0])
        nominal = _of_first(paths, index, permittivity.shape[0])
    else:
        index = jnp.asarray(paths.object_material)
        nominal = _of_first(paths, index, len(paths.material_names))
    above_one = [transforms.ExpTransform(), transforms.AffineTransform(1.0, 1.0, domain=constraints.positive)]
    with numpyro.plate("material", nominal.contrast.shape[0]):
        material_permittivity: Any = numpyro.sample(
            "material_permittivity",
            dist.TransformedDistribution(dist.Normal(nominal.contrast, nominal.contrast_spread), above_one),
        )
        material_conductivity: Any = numpyro.sample(
            "material_conductivity", dist.LogNormal(nominal.conductivity, nominal.conductivity_spread)
        )
    if materials == "hierarchical":
        contrast = _about("permittivity", material_permittivity[index] - 1.0)
        return 1.0 + contrast, _about("conductivity", material_conductivity[index])
    return material_permittivity[index], material_conductivity[index]


class _Nominal(NamedTuple):
    """Where the priors of materials lie, and how wide they are: logarithms of permittivity less one and conductivity."""

    contrast: Float[Array, " material"]
    conductivity: Float[Array, " material"]
    contrast_spread: Float[Array, ""] | float = _CONTRAST_SPREAD
    conductivity_spread: Float[Array, ""] | float = _CONDUCTIVITY_SPREAD


def _logarithms(paths: PathSet) -> tuple[Float[Array, " object"], Float[Array, " object"]]:
    """Of the scene's permittivity less one and of its conductivity, by object, vacuum's kept finite."""
    permittivity, conductivity = jnp.asarray(paths.permittivity), jnp.asarray(paths.conductivity)
    return jnp.log(jnp.maximum(permittivity - 1.0, 1e-2)), jnp.log(jnp.maximum(conductivity, 1e-4))


def _of_first(paths: PathSet, index: Int[Array, " object"], size: int) -> _Nominal:
    """Values of the first object of each material; a material without objects has some."""
    contrast, conductivity = _logarithms(paths)
    first = jax.ops.segment_min(jnp.arange(index.shape[0]), index, size)
    present = first < index.shape[0]
    place = jnp.where(present, first, 0)
    return _Nominal(
        jnp.where(present, contrast[place], 0.0), jnp.where(present, conductivity[place], jnp.log(1e-2))
    )


def _typical(paths: PathSet) -> _Nominal:
    """The median over the objects that paths hit, metals aside, with the spread of their own values added.

    Where no path hits anything all objects count, and metals count where there is nothing else.
    """
    hit = jnp.asarray(paths.mask)[:, :, None] & (jnp.asarray(paths.interaction) != NONE)
    counts = jnp.zeros(paths.n_object, int).at[jnp.asarray(paths.object)].add(hit.astype(int)) > 0
    counts = jnp.where(jnp.any(counts), counts, True)
    dielectric = counts & (jnp.asarray(paths.conductivity) <= _METAL)
    counts = jnp.where(jnp.any(dielectric), dielectric, counts)

    def told(values: Float[Array, " object"], spread: float) -> tuple[Array, Array]:
        centre = jnp.nanmedian(jnp.where(counts, values, jnp.nan))
        off = jnp.sum(jnp.where(counts, (values - centre) ** 2, 0.0)) / jnp.sum(counts)
        return centre[None], jnp.sqrt(spread**2 + off)

    contrast, conductivity = _logarithms(paths)
    centre, width = told(contrast, _CONTRAST_SPREAD)
    other, wide = told(conductivity, _CONDUCTIVITY_SPREAD)
    return _Nominal(centre, other, width, wide)


def _about(name: str, centre: jax.Array) -> jax.Array:
    """Values of objects about those of their classes, by factors of an unknown spread, expected about a tenth."""
    spread: Any = numpyro.sample(f"{name}_spread", dist.LogNormal(jnp.log(0.1), 1.0))
    with numpyro.plate("object", centre.shape[0]):
        deviation: Any = numpyro.sample(f"{name}_deviation", dist.Normal(0.0, 1.0))
    return centre * jnp.exp(spread * deviation)


def traced_gain(paths: PathSet, materials: Materials, law: Law) -> Complex[Array, "link path"]:
    """The site `path_gain` and, before it, those of what the objects are made of.

    Where the path set keeps paths of other traces, the site `path_share` comes before it, too: 1 for the twin's own paths,
    0 for the others, in amplitude. What an effect lets in there is then weakened like any other path.

    Args:
        paths: propagation paths of each link.
        materials: which permittivities and conductivities are unknown.
        law: "slab" (finite thickness) or "half_space".
    """
    permittivity, conductivity = unknown_materials(paths, materials)
    permittivity = site("permittivity", permittivity)
    conductivity = site("conductivity", conductivity)
    thickness = site("thickness", jnp.asarray(paths.thickness))
    gain = field.path_gain(with_all(paths), permittivity, conductivity, thickness=thickness, law=law)
    if paths.beyond_names:
        gain = gain * site("path_share", paths.mask.astype(float))
    return site("path_gain", gain)


def unknown_phase() -> dist.VonMises:
    """An angle of which nothing is known: uniform to 1e-9, and it can be sampled."""
    return dist.VonMises(0.0, 1e-9)


def site(name: str, value: jax.Array) -> jax.Array:
    """A named intermediate, on which effects act."""
    return jnp.asarray(numpyro.deterministic(name, value))


def array_response(array: jax.Array | None, direction: jax.Array, frequency: float, sign: float) -> jax.Array:
    """Phase of each element of an array on each path; one element at the centre where there is no array."""
    if array is None:
        array = jnp.zeros((1, 3))
    return field.steering(array, direction, frequency, sign)


def unknown_noise_power(noise_power: Any, paths: PathSet) -> jax.Array:
    """Variance of the noise, broadcastable to the channel: around the given level, or a very vague one.

    Args:
        noise_power: E |noise|^2 per entry, a number or one per link; None where it is not known.
        paths: of the links.

    Raises:
        InputError: another shape, or a known level that is not positive.
    """
    if noise_power is not None:
        _check_noise(noise_power, paths.n_link)
    if noise_power is None:
        free_space = jnp.where(paths.mask, (paths.wavelength / (4 * jnp.pi * paths.length)) ** 2, 0.0)
        reference, spread = 1e-2 * jnp.mean(jnp.sum(free_space, axis=1)), 3.5
    else:
        reference, spread = jnp.asarray(noise_power), 0.1
    level: Any = numpyro.sample("noise_level", dist.LogNormal(0.0, spread))
    reference = jnp.broadcast_to(reference, (paths.delay.shape[0],)) if jnp.ndim(reference) else reference
    return (level * reference).reshape((-1, 1, 1, 1, 1))


def _check_noise(noise_power: Any, n_link: int) -> None:
    expected, remedy = (
        f"positive values, one or one for each of {n_link} links",
        "Give the variance of the noise",
    )
    if jnp.shape(noise_power) not in {(), (1,), (n_link,)}:
        raise InputError("noise_power", expected, f"shape {jnp.shape(noise_power)}", remedy)
    if not isinstance(noise_power, Tracer) and not np.all(np.asarray(noise_power) > 0):
        raise InputError("noise_power", expected, f"{np.min(np.asarray(noise_power)):g}", remedy)


def observe(
    noiseless: Complex[Array, "link snapshot rx_antenna tx_antenna subcarrier"],
    noise: jax.Array,
    shape: tuple[int, int, int, int, int],
    channel: jax.Array | None,
) -> None:
    """The site `channel`: what is measured in circular Gaussian noise.

    Args:
        noiseless: the channel, broadcastable to `shape`.
        noise: variance, broadcastable to `shape`.
        shape: of the measurement.
        channel: the measurement.
    """
    with (
        numpyro.plate("link", shape[0], dim=-5),
        numpyro.plate("snapshot", shape[1], dim=-4),
        numpyro.plate("rx_antenna", shape[2], dim=-3),
        numpyro.plate("tx_antenna", shape[3], dim=-2),
        numpyro.plate("subcarrier", shape[4], dim=-1),
    ):
        numpyro.sample("channel", ComplexNormal(noiseless, noise), obs=channel)
