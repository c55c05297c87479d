"""What disturbs a measurement at random: thermal noise, and the laws that replace it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Complex, Float

from dtprob.physical.channel import Sounding
from dtprob.physical.information import (
    colour_information,
    impulse_information,
    power_information,
    projected,
)
from dtprob.physical.waveform import to_frequency, to_time

_WAVES: Final = 64
"""Waves of the error of rounding that are counted; enough for steps of up to 60 deviations of the noise."""
_LEAST: Final = 1e-6
"""Share of the variance of the noise that is left at least."""


@dataclass(frozen=True)
class Noise:
    """The law of the noise of every entry of a channel.

    Attributes:
        power: E |noise|^2 before impulses and rounding.
        colour: covariance over subcarriers of unit mean power; None for white noise.
        impulse_probability: how often an entry is hit.
        impulse_ratio: power of an impulse over that of the background.
        step: of the converter that rounds real and imaginary part of every time sample; 0 for none.
    """

    power: Float[np.ndarray, "#link #snapshot #rx_antenna #tx_antenna #subcarrier"]
    colour: Complex[np.ndarray, "subcarrier subcarrier"] | None = None
    impulse_probability: float = 0.0
    impulse_ratio: float = 0.0
    step: Float[np.ndarray, "#link #snapshot #rx_antenna 1 1"] | None = None

    def measure(
        self,
        rng: np.random.Generator,
        channel: Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"],
        sounding: Sounding,
    ) -> Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"]:
        """One noisy measurement of a channel."""
        noise = circular(rng, channel.shape)
        hits = rng.random(channel.shape) < self.impulse_probability
        noise += np.where(hits, np.sqrt(self.impulse_ratio) * circular(rng, channel.shape), 0)
        if self.colour is not None:
            noise = noise @ np.linalg.cholesky(self.colour).T
        received = channel + np.sqrt(self.power) * noise
        return received if self.step is None else _rounded(received, self.step, sounding)

    def mean_power(self, shape: tuple[int, ...]) -> float:
        """Mean power over all entries, rounding included."""
        impulses = self.power * self.impulse_probability * self.impulse_ratio
        return float(np.mean(np.broadcast_to(self.level + impulses, shape)))

    def information(
        self,
        channel: Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"],
        sounding: Sounding,
        tangents: Complex[np.ndarray, "nuisance entry"],
        precision: Float[np.ndarray, " nuisance"] | None = None,
    ) -> float:
        """Twice the expected gain in log-likelihood of this law over white noise of the best level.

        A step that is wider than the noise rounds the same signal in the same way each time: a shift of the mean.

        Args:
            channel: the noiseless one.
            sounding: subcarriers and snapshots.
            tangents: derivative of the mean by each free parameter of the base model.
            precision: prior precision of each; none when None.
        """
        count, power, left = channel.size, np.broadcast_to(self.power, channel.shape), 0.0
        if self.step is not None:
            shift, variance = rounding(channel, self.power, self.step, sounding)
            power = np.broadcast_to(variance, channel.shape)
            seen = projected(shift.reshape(-1), tangents, float(np.mean(power)), precision)
            left = float(seen @ seen)
        total = power_information(power) + 2 * count * np.log1p(left / np.sum(power))
        total += impulse_information(self.impulse_probability, self.impulse_ratio, count)
        if self.colour is not None:
            total += colour_information(self.colour, count // len(self.colour))
        return total

    @property
    def level(self) -> Float[np.ndarray, "#link #snapshot #rx_antenna #tx_antenna #subcarrier"]:
        """Mean square of each entry between impulses; the rounding error is uniform in a square of side `step`."""
        return self.power if self.step is None else self.power + self.step**2 / 6


def circular(rng: np.random.Generator, shape: tuple[int, ...]) -> Complex[np.ndarray, "..."]:
    """Circular complex normal draws of unit power."""
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def rounding(
    channel: Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"],
    power: Float[np.ndarray, "#link #snapshot #rx_antenna #tx_antenna #subcarrier"],
    step: Float[np.ndarray, "#link #snapshot #rx_antenna 1 1"],
    sounding: Sounding,
) -> tuple[
    Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"],
    Float[np.ndarray, "link snapshot rx_antenna tx_antenna 1"],
]:
    """By how much rounding shifts the mean of each entry of a noisy channel, and the variance that it leaves.

    Moments of the rounded normal law follow from the Fourier series of the error of rounding; a wave in it is weakened by
    exp(-2 (pi k deviation / step)^2). Source: Widrow and Kollar, Quantization Noise, Cambridge 2008.

    Args:
        channel: the noiseless one.
        power: of the noise, E |noise|^2.
        step: of the converter that rounds real and imaginary part of every time sample.
        sounding: subcarriers and snapshots.
    """
    wide = np.where(step > 0, step, 1.0)
    deviation = np.sqrt(np.mean(power, axis=-1, keepdims=True) / 2) / wide
    wave = to_time(channel, sounding) / wide
    parts = np.stack([np.real(wave), np.imag(wave)])
    shift, square = np.zeros(parts.shape), deviation**2 + np.full(parts.shape, 1 / 12)
    for k in range(1, min(_WAVES, int(np.ceil(1.1 / deviation.min()))) + 1):
        weight = (-1) ** k * np.exp(-2 * (np.pi * k * deviation) ** 2)
        shift += weight * np.sin(2 * np.pi * k * parts) / (np.pi * k)
        square += weight * np.cos(2 * np.pi * k * parts) * (1 / (np.pi * k) ** 2 + 4 * deviation**2)
    variance = np.maximum(np.mean(square - shift**2, axis=-1, keepdims=True), _LEAST * deviation**2)
    moved = to_frequency(wide * (shift[0] + 1j * shift[1]), sounding)
    own = np.broadcast_to(np.mean(power, axis=-1, keepdims=True), variance.shape[1:])
    return np.where(step > 0, moved, 0.0), np.where(step > 0, wide**2 * variance.sum(axis=0), own)


def _rounded(
    channel: Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"],
    step: Float[np.ndarray, "#link #snapshot #rx_antenna 1 1"],
    sounding: Sounding,
) -> Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"]:
    wave = to_time(channel, sounding)
    positive = np.where(step > 0, step, 1.0)
    grid = positive * (np.round(np.real(wave) / positive) + 1j * np.round(np.imag(wave) / positive))
    return to_frequency(np.where(step > 0, grid, wave), sounding)
