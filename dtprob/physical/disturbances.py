"""Impairments of the noise: interferers, filters and sparks."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from dtprob.physical.channel import Sounding
from dtprob.physical.impairment import Channel, Impairment
from dtprob.physical.noise import Noise


def interference(
    links: Bool[np.ndarray, " link"],
    snapshots: Bool[np.ndarray, " snapshot"],
    subcarriers: Bool[np.ndarray, " subcarrier"],
    limit: float = 1e4,
) -> Impairment:
    """A narrow-band transmitter is on during some snapshots of some links.

    Size is its power over that of the noise. Its signal is independent from entry to entry, as data symbols
    are.

    Args:
        links: which links it disturbs.
        snapshots: which snapshots.
        subcarriers: which subcarriers.
        limit: of the size.
    """
    where = (
        links[:, None, None, None, None]
        & snapshots[:, None, None, None]
        & subcarriers[None, None, None, None, :]
    )

    def disturb(noise: Noise, _channel: Channel, _sounding: Sounding, size: float) -> Noise:
        return dataclasses.replace(noise, power=noise.power * (1 + size * where))

    detail = {
        "links": np.flatnonzero(links).tolist(),
        "snapshots": np.flatnonzero(snapshots).tolist(),
        "subcarriers": np.flatnonzero(subcarriers).tolist(),
    }
    return Impairment("interference", "1", limit, noise=disturb, detail=detail)


def colored_noise(centre: float, limit: float = 20.0) -> Impairment:
    """The noise passed a resonant circuit; its mean power stays.

    The power falls as 1 / (1 + (2 size (f - centre) / B)^2).

    Args:
        centre: of the resonance, Hz from the carrier.
        limit: of the size, the bandwidth over that of the circuit.
    """

    def colour(noise: Noise, _channel: Channel, sounding: Sounding, size: float) -> Noise:
        detuning = 2 * size * (sounding.subcarrier_frequency - centre) / sounding.bandwidth
        shape = 1 / (1 + detuning**2)
        return dataclasses.replace(noise, power=noise.power * shape / np.mean(shape))

    return Impairment("colored_noise", "1", limit, noise=colour, detail={"centre": centre})


def correlated_noise(limit: float = 0.99) -> Impairment:
    """The noise of neighbouring subcarriers is correlated, n_k = size n_{k-1} + w_k; its power stays.

    Estimators that smooth or interpolate over pilots leave such noise.
    """

    def correlate(noise: Noise, _channel: Channel, sounding: Sounding, size: float) -> Noise:
        index = np.arange(len(sounding.subcarrier_frequency))
        covariance = size ** np.abs(index[:, None] - index) if size else np.eye(len(index))
        return dataclasses.replace(noise, colour=covariance.astype(complex))

    return Impairment("correlated_noise", "1", limit, noise=correlate)


def noise_imbalance(draw: Float[np.ndarray, " rx_antenna"], limit: float = 3.0) -> Impairment:
    """The receiving chains have noise figures of their own: exp(size * draw) times the power."""

    def weigh(noise: Noise, _channel: Channel, _sounding: Sounding, size: float) -> Noise:
        return dataclasses.replace(noise, power=noise.power * np.exp(size * draw)[:, None, None])

    return Impairment(
        "noise_imbalance", "1", limit, instance="rx", noise=weigh, detail={"draw": draw.tolist()}
    )


def heavy_tailed_noise(probability: float, limit: float = 1e4) -> Impairment:
    """Sparks: an entry is hit with some probability by an impulse of `size` times the noise's power.

    Middleton's class A cut after its second term (Bernoulli-Gaussian).
    """

    def spark(noise: Noise, _channel: Channel, _sounding: Sounding, size: float) -> Noise:
        hit = probability if size else 0.0
        return dataclasses.replace(noise, impulse_probability=hit, impulse_ratio=size)

    return Impairment("heavy_tailed_noise", "1", limit, noise=spark, detail={"probability": probability})
