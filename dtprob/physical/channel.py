"""The channel that a campaign measures before any hardware: rays, arrays and subcarriers, double precision.

H[link, snapshot, rx, tx, k] = sum_p a_p exp(-j 2 pi (f_c + f_k) tau_p) (array responses), time convention
e^{+j w t}.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from dtprob.errors import InputError
from dtprob.physical.rays import Rays
from dtprob.physical.world import SPEED_OF_LIGHT, World, rotation


@dataclass(frozen=True)
class Sounding:
    """How the channel is measured.

    Attributes:
        subcarrier_frequency: Hz from the carrier, equally spaced and symmetric about it.
        snapshot_time: s.
    """

    subcarrier_frequency: Float[np.ndarray, " subcarrier"]
    snapshot_time: Float[np.ndarray, " snapshot"]

    def __post_init__(self) -> None:
        grid = np.asarray(self.subcarrier_frequency, np.float64)
        if len(grid) < 2 or not np.allclose(grid, -grid[::-1], atol=1e-6 * abs(grid[0])):
            raise InputError(
                "sounding.subcarrier_frequency",
                "two or more frequencies, symmetric about the carrier",
                np.array2string(grid, threshold=6),
                "Make them with `subcarriers`",
            )

    @property
    def spacing(self) -> float:
        """Subcarrier spacing, Hz."""
        return float(self.subcarrier_frequency[1] - self.subcarrier_frequency[0])

    @property
    def bandwidth(self) -> float:
        """Number of subcarriers times their spacing, Hz."""
        return self.spacing * len(self.subcarrier_frequency)

    @property
    def sample_time(self) -> Float[np.ndarray, " subcarrier"]:
        """Instants of the samples of one symbol from its centre, s."""
        count = len(self.subcarrier_frequency)
        return (np.arange(count) - (count - 1) / 2) / self.bandwidth


def subcarriers(count: int, bandwidth: float) -> Float[np.ndarray, " subcarrier"]:
    """Frequencies of `count` subcarriers across a bandwidth, in Hz from the carrier, symmetric about it."""
    return (np.arange(count) - (count - 1) / 2) * (bandwidth / count)


def array_responses(
    world: World, rays: Rays
) -> tuple[Complex[np.ndarray, "link path rx_antenna"], Complex[np.ndarray, "link path tx_antenna"]]:
    """Plane-wave, narrow-band phases of the elements of both arrays, turned as they are in the world."""
    wavenumber = 2 * np.pi / world.wavelength
    rx = world.rx_array @ rotation(world.rx_turn).T
    tx = world.tx_array @ rotation(world.tx_turn).T
    return (
        np.exp(-1j * wavenumber * np.einsum("lpi,ai->lpa", rays.arrival, rx)),
        np.exp(1j * wavenumber * np.einsum("lpi,ai->lpa", rays.departure, tx)),
    )


def path_channels(
    world: World, rays: Rays, sounding: Sounding
) -> Complex[np.ndarray, "link snapshot path rx_antenna tx_antenna subcarrier"]:
    """What each path adds to the channel."""
    rx, tx = array_responses(world, rays)
    carrier = np.exp(-2j * np.pi * np.modf(world.frequency * rays.delay)[0])
    tone = np.exp(-2j * np.pi * rays.delay[..., None] * sounding.subcarrier_frequency)
    return np.einsum(
        "lsp,lpa,lpb,lspk->lspabk", np.where(rays.mask[:, None], rays.gain * carrier, 0), rx, tx, tone
    )


def synthesise(
    world: World, rays: Rays, sounding: Sounding
) -> Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"]:
    """The noiseless channel at every snapshot, with plane waves and array phases of the carrier."""
    return _at_snapshots(path_channels(world, rays, sounding).sum(axis=2), sounding)


def synthesise_wide(
    world: World, rays: Rays, sounding: Sounding, curvature: float, squint: float
) -> Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"]:
    """The noiseless channel with wave fronts that bend and array phases that follow the frequency.

    Args:
        world: the arrays and the carrier.
        rays: the paths.
        sounding: subcarriers and snapshots.
        curvature: 0 for plane waves, 1 for the exact distance between every pair of elements.
        squint: 0 for array phases of the carrier at every subcarrier, 1 for those of the subcarrier.
    """
    rx = world.rx_array @ rotation(world.rx_turn).T
    tx = world.tx_array @ rotation(world.tx_turn).T
    step = np.einsum("lpij,aj->lpai", rays.mirror, rx)[:, None, :, :, None] - tx
    exact = np.linalg.norm(rays.unfolded[:, :, :, None, None] + step, axis=-1)
    centre = rays.length[..., None, None]
    plane = centre + np.einsum("lpi,lpabi->lpab", rays.departure, step[:, 0])[:, None]
    length = plane + curvature * (exact - plane)
    carrier = np.exp(-2j * np.pi * np.modf(length / world.wavelength)[0])
    late = (centre + squint * (length - centre)) / SPEED_OF_LIGHT
    gain = np.where(rays.mask[:, None], rays.gain, 0)
    channel = np.stack(
        [
            np.einsum("lsp,lspab->lsab", gain, carrier * np.exp(-2j * np.pi * offset * late))
            for offset in sounding.subcarrier_frequency
        ],
        axis=-1,
    )
    return _at_snapshots(channel, sounding)


def _at_snapshots(
    channel: Complex[np.ndarray, "link instant rx_antenna tx_antenna subcarrier"], sounding: Sounding
) -> Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"]:
    count = len(sounding.snapshot_time)
    return np.repeat(channel, count, axis=1) if channel.shape[1] == 1 else channel


def mean_power(channel: Complex[np.ndarray, "..."]) -> float:
    """Mean |H|^2 over all entries."""
    return float(np.mean(np.abs(channel) ** 2))
