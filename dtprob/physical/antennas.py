"""Impairments of the arrays: element gains that nobody calibrated, and currents induced in other elements."""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex, Float

from dtprob.physical.channel import Sounding
from dtprob.physical.impairment import Channel, Impairment
from dtprob.physical.waveform import resample, to_frequency, to_time
from dtprob.physical.world import World

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)
_FREE_SPACE_OVER_4PI = 29.9792458
"""Free-space impedance over 4 pi, ohm."""
_RADIUS = 1e-3
"""Of a dipole's wire, in wavelengths."""


def array_calibration(draw: Complex[np.ndarray, " rx_antenna"], limit: float = 2.0) -> Impairment:
    """Every receiving element has a gain of its own, exp(size * draw): real part in Np, imaginary in rad."""

    def weigh(_world: World, channel: Channel, _sounding: Sounding, size: float) -> Channel:
        return channel * np.exp(size * draw)[:, None, None]

    detail = {"amplitude": np.real(draw).tolist(), "phase": np.imag(draw).tolist()}
    return Impairment("array_calibration", "1", limit, instance="rx", channel=weigh, detail=detail)


def cable_delay(antenna: int, limit: float = 1e-8) -> Impairment:
    """The cable of one receiving element is longer: its waveform comes late by `size` seconds."""

    def late(_world: World, channel: Channel, sounding: Sounding, size: float) -> Channel:
        wave = to_time(channel[:, :, antenna], sounding)
        delayed = to_frequency(resample(wave, sounding, sounding.sample_time - size), sounding)
        own = np.arange(channel.shape[2]) == antenna
        return np.where(own[:, None, None], delayed[:, :, None], channel)

    return Impairment("cable_delay", "s", limit, instance=f"rx_{antenna}", channel=late)


def mutual_coupling(load: complex = 73.13 - 42.54j, limit: float = 5.0) -> Impairment:
    """The receiving elements are half-wave dipoles along z that induce voltages in one another.

    v = Z_L (Z + Z_L I)^-1 v_open, as against the isolated element's Z_L / (Z_11 + Z_L); size scales the
    mutual impedances, 1 is what they are. Source: Balanis, Antenna Theory, 4th ed., chapter 8.

    Args:
        load: impedance of each receiver, ohm; the conjugate of the dipole's own by default.
        limit: of the size.
    """

    def couple(world: World, channel: Channel, _sounding: Sounding, size: float) -> Channel:
        impedance = impedance_matrix(world.rx_array / world.wavelength)
        own = impedance[0, 0]
        mutual = impedance - np.diag(np.diag(impedance))
        count = len(impedance)
        alone = (own + load) * np.eye(count)
        return np.einsum("ij,lsjbk->lsibk", (own + load) * np.linalg.inv(alone + size * mutual), channel)

    return Impairment("mutual_coupling", "1", limit, instance="rx", channel=couple)


def impedance_matrix(elements: Float[np.ndarray, "antenna 3"]) -> Complex[np.ndarray, "antenna antenna"]:
    """Self and mutual impedances of half-wave dipoles along z, in ohm, by the induced-EMF method.

    Args:
        elements: their centres, in wavelengths.
    """
    step = elements[:, None] - elements[None]
    across = np.hypot(step[..., 0], step[..., 1])
    np.fill_diagonal(across, _RADIUS)
    return _mutual_impedance(across, step[..., 2])


def _mutual_impedance(
    across: Float[np.ndarray, "*n"], along: Float[np.ndarray, "*n"]
) -> Complex[np.ndarray, "*n"]:
    """Integral of one dipole's field over the other's sinusoidal current; distances in wavelengths."""
    total = np.zeros(across.shape, complex)
    for centre in (-0.125, 0.125):
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            z = centre + 0.125 * node
            total += 0.125 * weight * np.cos(2 * np.pi * z) * _field(across, along + z)
    return 1j * _FREE_SPACE_OVER_4PI * total


def _field(across: Float[np.ndarray, "*n"], z: Float[np.ndarray, "*n"]) -> Complex[np.ndarray, "*n"]:
    """Spherical waves from both ends of a half-wave dipole; the feed's wave has no weight at this length."""
    ends = (np.hypot(across, z - 0.25), np.hypot(across, z + 0.25))
    return sum((np.exp(-2j * np.pi * end) / end for end in ends), start=np.zeros(across.shape, complex))
