"""Numbers that are possible, but look as if they were in another unit."""

from collections.abc import Iterator
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from scipy.constants import speed_of_light
from scipy.spatial.distance import pdist

from dtprob.data import ChannelData, PowerData
from dtprob.raytracing.calibration import project
from dtprob.raytracing.paths import PathSet

_SPARSE: Final = 2.0
"""Wavelengths between nearest elements from which an array looks as if it were not in metres."""
_LOUD: Final = 10.0
"""How often the measured power, its noise included, the noise power may be."""

_MIRRORED: Final = 0.5
"""How much less than of the channel its paths may leave of its conjugate."""
_UNEXPLAINED: Final = 0.05
"""Share of the channel's energy below which its paths explain it well enough."""
_LOOKED_AT: Final = 16
"""Links, and snapshots of each, of which that is looked at, about."""
_SMALLEST: Final = 1e-9
"""Directions of the paths' span below this share of the largest say nothing."""


def doubts(data: ChannelData | PowerData, frequency: float) -> Iterator[str]:
    """A line for each thing that is probably in another unit.

    Args:
        data: what was measured.
        frequency: carrier in Hz.
    """
    wavelength = speed_of_light / frequency
    for name in ("rx_array", "tx_array"):
        array = getattr(data, name)
        apart = pdist(array) if array is not None and len(array) > 1 else np.zeros(0)
        apart = apart[apart > 0]
        if apart.size and apart.min() > _SPARSE * wavelength:
            least, waves = apart.min(), apart.min() / wavelength
            yield f"elements of {name} are {least:.3g} m apart, {waves:.3g} wavelengths: are they in m?"
    if data.noise_power is not None:
        axes = tuple(range(1, _measured(data).ndim))
        measured = _measured(data).mean(axis=axes)
        ratio = np.median(data.noise_power / np.maximum(measured, np.finfo(float).tiny))
        if ratio > _LOUD:
            yield (
                f"noise_power is {10 * np.log10(ratio):.0f} dB above the power that was measured with it: "
                "is it linear, and in the unit of the data?"
            )


def mirrored(data: ChannelData | PowerData, paths: PathSet) -> Iterator[str]:
    """A line where the channel looks as if it were of the other sign of phases.

    Args:
        data: what was measured.
        paths: of its links.
    """
    if isinstance(data, ChannelData):
        own, conjugated = _left(data, paths)
        if own > _UNEXPLAINED and conjugated < _MIRRORED * own:
            yield (
                f"the paths leave {own:.0%} of the channel unexplained, and {conjugated:.0%} of its "
                "conjugate: a delay tau has to turn it by exp(-2j pi f tau), so should it be conjugated?"
            )


def _left(data: ChannelData, paths: PathSet) -> tuple[float, float]:
    """The shares of the energy of a few links, and of their conjugates, that no amplitudes of their paths explain."""
    links = np.arange(0, paths.n_link, -(-paths.n_link // _LOOKED_AT))
    measured = data.channel[links, :_LOOKED_AT]
    both = np.concatenate([measured, np.conj(measured)], axis=1)
    arrays: dict[str, Any] = {"rx_array": data.rx_array, "tx_array": data.tx_array}
    frequency: Any = data.subcarrier_frequency
    seen = project(paths.take(links), frequency, jnp.asarray(both), **arrays, powers=False)
    product = np.asarray(seen.product)
    solved = product @ np.linalg.pinv(np.asarray(seen.gram), _SMALLEST, hermitian=True).transpose(0, 2, 1)
    explained = np.real(solved * product.conj()).sum(axis=(0, 2)).reshape(2, -1).sum(axis=1)
    total = np.sum(np.abs(measured) ** 2)
    own, conjugated = np.maximum(1.0 - explained / total, 0.0) if total else np.ones(2)
    return float(own), float(conjugated)


def strayed(data: ChannelData | PowerData, scene: Any) -> Iterator[str]:
    """A line for each end that stands outside of the scene, as where the map has another origin or unit.

    Args:
        data: the positions of the links, m.
        scene: a ``sionna.rt.Scene``.
    """
    box = scene.mi_scene.bbox()
    low, high = (np.array([float(corner[i]) for i in range(2)]) for corner in (box.min, box.max))
    for name, position in (("rx_position", data.rx_position), ("tx_position", data.tx_position)):
        outside = np.any((position[:, :2] < low) | (position[:, :2] > high), axis=1)
        if outside.any():
            span = f"x {low[0]:.4g} to {high[0]:.4g} m, y {low[1]:.4g} to {high[1]:.4g} m"
            yield f"{name} of {outside.sum()} of {len(outside)} links lies outside of the scene ({span})"


def _measured(data: ChannelData | PowerData) -> np.ndarray:
    return np.abs(data.channel) ** 2 if isinstance(data, ChannelData) else data.power
