"""The channel models on sufficient statistics: the same posteriors, at a cost that knows neither antennas nor subcarriers.

A channel h = B c + noise, c_p = a_p exp(j z_p), is rotated onto the space that the paths span: with B^H B = U D U^H, the
numbers D^-1/2 U^H B^H h are normal about D^1/2 U^H c with white noise, and what remains of |h|^2 is noise alone. Both come
from `dtprob.raytracing.calibration.project`. Effects that change the paths' responses need the whole channel; see
`dtprob.models.channel`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jaxtyping import Array, Bool, Complex, Float
from numpyro import handlers

from dtprob.errors import InputError, check_choice
from dtprob.models.complex_normal import ComplexNormal
from dtprob.models.declaration import model
from dtprob.models.scene import AXES, TRACED, Materials, site, traced_gain, unknown_noise_power, unknown_phase
from dtprob.raytracing.calibration import Statistics, project
from dtprob.raytracing.paths import PathSet
from dtprob.raytracing.slab import Law

type PathPhase = Literal["coherent", "per_packet", "per_path"]
"""Phases as traced; with an unknown phase of each link and snapshot; with an unknown error of each path besides."""

_SMALLEST: Final = 1e-9
"""Directions of the paths' span whose part of the Gram matrix is smaller than this share of the largest are noise."""
_TINY: Final = 1e-30
"""Least energy of what is left, where it counts."""
_AXES: Final = {
    **{name: AXES[name] for name in TRACED},
    "path_phase": AXES["path_phase"],
    "path_power": ("link", "path"),
}


def compress(statistics: Statistics) -> dict[str, Any]:
    """Arguments of `compressed_channel` from the statistics of a measurement.

    Args:
        statistics: from `dtprob.raytracing.calibration.project`, against the path set of the model.
    """
    values, vectors = jnp.linalg.eigh(statistics.gram)
    kept = values > _SMALLEST * values[:, -1:]
    root = jnp.sqrt(jnp.where(kept, values, 1.0))
    adjoint = jnp.conj(jnp.swapaxes(vectors, 1, 2))
    onto = jnp.where(kept, 1 / root, 0.0)[:, :, None] * adjoint
    compressed = jnp.einsum("lcp,lsp->lsc", onto, statistics.product)
    explained = jnp.sum(jnp.abs(compressed) ** 2, axis=2)
    return {
        "mixing": jnp.where(kept, root, 0.0)[:, :, None] * adjoint,
        "kept": kept,
        "residual": jnp.maximum(statistics.energy - explained, 0.0),
        "size": statistics.size,
        "compressed": compressed,
    }


def compress_measured(measured: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `compressed_channel` from a measurement.

    Args:
        measured: the arrays of `dtprob.data.ChannelData` by name, and `paths`.
    """
    arrays = {name: measured.get(name) for name in ("rx_array", "tx_array")}
    given = {name: None if array is None else jnp.asarray(array) for name, array in arrays.items()}
    channel, tones = (jnp.asarray(measured[name]) for name in ("channel", "subcarrier_frequency"))
    return compress(project(measured["paths"], tones, channel, powers=False, **given))


@model(axes=_AXES, cluster="link")
def compressed_channel(
    paths: PathSet,
    mixing: Complex[Array, "link component path"],
    kept: Bool[Array, "link component"],
    residual: Float[Array, "link snapshot"],
    size: int,
    *,
    noise_power: Any = None,
    phase: PathPhase = "per_path",
    materials: Materials = "per_material",
    law: Law = "slab",
    compressed: Complex[Array, "link snapshot component"] | None = None,
) -> jax.Array:
    """`ray_traced_channel` or `phase_error_channel` on compressed data.

    Args:
        paths: propagation paths of each link.
        mixing: D^1/2 U^H, from `compress`, as are the next three.
        kept: components that hold signal.
        residual: what is left of |h|^2 beside the components.
        size: number of entries of h.
        noise_power: E |noise|^2 per entry of the channel, scalar or (link,), known to about 10%; unknown where absent.
        phase: what of the paths' phases is unknown; an error of each path has a concentration, unknown too.
        materials: which permittivities and conductivities are unknown, as for `ray_traced_channel`.
        law: "slab" (finite thickness) or "half_space".
        compressed: the measurement.

    Returns:
        The noiseless components.

    Raises:
        InputError: arguments of another number of links or paths.
    """
    links, snapshots = residual.shape
    if mixing.shape != (paths.n_link, paths.n_path, paths.n_path) or links != paths.n_link:
        expected = f"shape ({paths.n_link}, {paths.n_path}, {paths.n_path})"
        raise InputError("mixing", expected, str(mixing.shape), "Compress against the model's own path set")
    gain = traced_gain(paths, materials, law)
    angle = site("path_phase", _angles(phase, (links, snapshots, paths.n_path)))
    amplitude = gain[:, None] * jax.lax.complex(jnp.cos(angle), jnp.sin(angle))
    amplitude = jnp.broadcast_to(amplitude, (links, snapshots, paths.n_path))
    mean = jnp.einsum("lcp,lsp->lsc", mixing, amplitude)
    noise = site("noise_power", unknown_noise_power(noise_power, paths)).reshape(-1, 1, 1)
    rank = jnp.sum(kept, axis=1)[:, None]
    of_link, of_snapshot = numpyro.plate("link", links, dim=-3), numpyro.plate("snapshot", snapshots, dim=-2)
    free = jnp.broadcast_to(size - rank, residual.shape)[..., None]
    with of_link, of_snapshot, handlers.mask(mask=free > 0):
        # the energy of so many complex normal entries; where none is left it tells nothing
        energy = dist.Gamma(jnp.maximum(free, 1), 1 / noise)
        numpyro.sample("left", energy, obs=jnp.maximum(residual[..., None], _TINY))
    with (
        of_link,
        of_snapshot,
        numpyro.plate("component", mixing.shape[1], dim=-1),
        handlers.mask(mask=kept[:, None]),
    ):
        numpyro.sample("compressed", ComplexNormal(mean, noise), obs=compressed)
    return mean


def _angles(phase: PathPhase, shape: tuple[int, int, int]) -> Any:
    check_choice("phase", phase, get_args(PathPhase.__value__))
    if phase == "coherent":
        return jnp.zeros((1, 1, 1))
    with numpyro.plate("link", shape[0], dim=-3), numpyro.plate("snapshot", shape[1], dim=-2):
        if phase == "per_packet":
            with numpyro.plate("packet", 1, dim=-1):
                return numpyro.sample("packet_phase", unknown_phase())
    concentration = numpyro.sample("phase_concentration", dist.LogNormal(0.0, 1.5))
    with (
        numpyro.plate("link", shape[0], dim=-3),
        numpyro.plate("snapshot", shape[1], dim=-2),
        numpyro.plate("path", shape[2], dim=-1),
    ):
        return numpyro.sample("phase_error", dist.VonMises(0.0, concentration))


def compress_powers(statistics: Statistics) -> dict[str, jax.Array]:
    """Arguments of `uniform_phase_channel` from the statistics of a measurement.

    Args:
        statistics: from `dtprob.raytracing.calibration.project`, with its powers.

    Raises:
        InputError: statistics without powers.
    """
    if statistics.power is None:
        raise InputError("statistics", "powers", "none", "Project with powers=True")
    values, vectors = jnp.linalg.eigh(statistics.power.normal)
    kept = values > _SMALLEST * values[:, -1:]
    root = jnp.sqrt(jnp.where(kept, values, 1.0))
    adjoint = jnp.swapaxes(vectors, 1, 2)
    onto = jnp.where(kept, 1 / root, 0.0)[:, :, None] * adjoint
    projected = jnp.einsum("lcp,lp->lc", onto, statistics.power.right)
    # in units of the powers that the twin's own materials could give
    scale = jnp.sqrt(jnp.mean(projected**2))
    mixing = jnp.where(kept, root, 0.0)[:, :, None] * adjoint
    return {"mixing": mixing / scale, "kept": kept, "powers": projected / scale}


@model(axes=_AXES, cluster="link")
def uniform_phase_channel(
    paths: PathSet,
    mixing: Float[Array, "link component path"],
    kept: Bool[Array, "link component"],
    *,
    materials: Materials = "per_material",
    law: Law = "slab",
    powers: Float[Array, "link component"] | None = None,
) -> jax.Array:
    """The rival that trusts no phase: measured powers over delays and angles against the sum of the paths' powers.

    A generalised posterior: its loss, squared differences over all combinations of a predicted delay, arrival and
    departure, is the literature's, turned into a normal density of unknown spread. Its maximum is that of the loss;
    the combinations are not independent and not normal, so its intervals are no more than an indication.

    Args:
        paths: propagation paths of each link.
        mixing: from `compress_powers`, as is the next.
        kept: components that hold signal.
        materials: which permittivities and conductivities are unknown, as for `ray_traced_channel`.
        law: "slab" (finite thickness) or "half_space".
        powers: the measurement, from `compress_powers`.

    Returns:
        The powers that the paths make.

    Source: the rival "uniform phases" of Ruah, Simeone, Hoydis and Al-Hashimi (arXiv 2312.12625).
    """
    gain = traced_gain(paths, materials, law)
    each = site("path_power", jnp.real(gain) ** 2 + jnp.imag(gain) ** 2)
    mean = jnp.einsum("lcp,lp->lc", mixing, each)
    spread: Any = numpyro.sample("power_spread", dist.LogNormal(np.log(0.1), 2.0))
    with (
        numpyro.plate("link", mixing.shape[0], dim=-2),
        numpyro.plate("component", mixing.shape[1], dim=-1),
        handlers.mask(mask=kept),
    ):
        numpyro.sample("powers", dist.Normal(mean, spread), obs=powers)
    return mean
