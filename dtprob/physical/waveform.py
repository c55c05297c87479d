"""From subcarriers to the samples of a symbol and back, unitary, with time zero at the symbol's centre."""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex, Float

from dtprob.physical.channel import Sounding


def to_time(
    spectrum: Complex[np.ndarray, "*n subcarrier"], sounding: Sounding
) -> Complex[np.ndarray, "*n sample"]:
    """Samples of one symbol whose subcarriers carry `spectrum`."""
    return spectrum @ _basis(sounding)


def to_frequency(
    wave: Complex[np.ndarray, "*n sample"], sounding: Sounding
) -> Complex[np.ndarray, "*n subcarrier"]:
    """Subcarriers of one symbol."""
    return wave @ _basis(sounding).conj().T


def _basis(sounding: Sounding) -> Complex[np.ndarray, "subcarrier sample"]:
    grid = sounding.subcarrier_frequency
    return np.exp(2j * np.pi * grid[:, None] * sounding.sample_time) / np.sqrt(len(grid))


def resample(
    wave: Complex[np.ndarray, "*n sample"], sounding: Sounding, instant: Float[np.ndarray, "*n sample"]
) -> Complex[np.ndarray, "*n sample"]:
    """The band-limited periodic waveform at other instants (s), interpolated by the Dirichlet kernel."""
    count = wave.shape[-1]
    away = (instant[..., :, None] - sounding.sample_time) * sounding.bandwidth
    numerator, denominator = np.sin(np.pi * away), count * np.sin(np.pi * away / count)
    near = np.abs(denominator) < 1e-9
    sign = np.where(np.round(away / count) % 2 == 0, 1.0, -1.0) if count % 2 == 0 else 1.0
    kernel = np.where(near, sign, numerator / np.where(near, 1.0, denominator))
    return np.einsum("...ij,...j->...i", kernel, wave)


def chirp(count: int) -> Complex[np.ndarray, " subcarrier"]:
    """A pilot of constant envelope in time and frequency that sweeps the band once (Zadoff-Chu)."""
    k = np.arange(count)
    return np.exp(1j * np.pi * k * (k + 1) / count)


def symmetric_pilot(rng: np.random.Generator, count: int) -> Float[np.ndarray, " subcarrier"]:
    """A real pilot of random signs, equal on subcarriers that mirror each other."""
    half = rng.choice([-1.0, 1.0], size=(count + 1) // 2)
    return np.concatenate([half[::-1], half[count % 2 :]])
