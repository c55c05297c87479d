"""What disturbs a measurement at random: thermal noise, and the laws that replace it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from dtprob.physical.channel import Sounding
from dtprob.physical.information import (
    colour_information,
    impulse_information,
    power_information,
)
from dtprob.physical.waveform import to_frequency, to_time


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

    def information(self, shape: tuple[int, ...]) -> float:
        """Twice the expected gain in log-likelihood of this law over white noise of the best level."""
        count = int(np.prod(shape))
        power = np.broadcast_to(self.level, shape)
        total = power_information(power)
        total += impulse_information(self.impulse_probability, self.impulse_ratio, count)
        if self.colour is not None:
            total += colour_information(self.colour, count // len(self.colour))
        return total

    @property
    def level(self) -> Float[np.ndarray, "#link #snapshot #rx_antenna #tx_antenna #subcarrier"]:
        """Power of each entry between impulses; the rounding error is uniform in a square of side `step`."""
        return self.power if self.step is None else self.power + self.step**2 / 6


def circular(rng: np.random.Generator, shape: tuple[int, ...]) -> Complex[np.ndarray, "..."]:
    """Circular complex normal draws of unit power."""
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def _rounded(
    channel: Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"],
    step: Float[np.ndarray, "#link #snapshot #rx_antenna 1 1"],
    sounding: Sounding,
) -> Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"]:
    wave = to_time(channel, sounding)
    positive = np.where(step > 0, step, 1.0)
    grid = positive * (np.round(np.real(wave) / positive) + 1j * np.round(np.imag(wave) / positive))
    return to_frequency(np.where(step > 0, grid, wave), sounding)
