"""Alignment finds what was put in, to the accuracy that the noise allows."""

import numpy as np
import pytest

from dtprob.data.alignment import align, weighted_mean

FREQUENCY = np.arange(-31, 32) * 7.8e6


def packets(rng, count, noise, jumps):
    """Copies of one response with random gains, phases and delays (some off by several samples)."""
    tau = np.sort(rng.uniform(0, 60e-9, 12))
    paths = rng.normal(size=12) + 1j * rng.normal(size=12)
    response = paths @ np.exp(-2j * np.pi * np.outer(tau, FREQUENCY))
    response /= np.sqrt(np.mean(np.abs(response) ** 2))
    gain = rng.uniform(0.5, 2, count) * np.exp(2j * np.pi * rng.uniform(size=count))
    delay = rng.uniform(-0.5e-9, 0.5e-9, count) + 3e-9 * jumps * rng.integers(-1, 2, count)
    clean = gain[:, None] * response * np.exp(-2j * np.pi * FREQUENCY * delay[:, None])
    error = rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape)
    return response, gain, delay, clean + noise * error / np.sqrt(2)


@pytest.mark.parametrize("jumps", [0, 1])
def test_without_noise_alignment_is_exact(jumps):
    response, gain, delay, measured = packets(np.random.default_rng(1), 30, 0.0, jumps)
    found = align(measured, FREQUENCY, reach=8e-9)
    assert found.residual.max() < 1e-10
    np.testing.assert_allclose(np.diff(found.delay), np.diff(delay), atol=1e-15)
    ratio = found.gain / gain
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)
    overlap = np.abs(
        np.vdot(found.response * np.exp(2j * np.pi * FREQUENCY * (delay - found.delay)[0]), response)
    )
    np.testing.assert_allclose(overlap, len(FREQUENCY), rtol=1e-9)


def test_delay_error_reaches_the_cramer_rao_bound():
    rng = np.random.default_rng(2)
    noise, errors, bounds = 0.1, [], []
    for _ in range(10):
        response, gain, delay, measured = packets(rng, 40, noise, 1)
        found = align(measured, FREQUENCY, reach=8e-9)
        error = found.delay - delay
        weight = np.abs(response) ** 2
        omega = 2 * np.pi * (FREQUENCY - np.sum(weight * FREQUENCY) / np.sum(weight))
        bounds.append(noise**2 / (2 * np.abs(gain) ** 2 * np.sum(weight * omega**2)))
        errors.append(error - np.average(error, weights=1 / bounds[-1]))
    z = np.concatenate(errors) / np.sqrt(np.concatenate(bounds))
    # 390 degrees of freedom: the mean square of z has a standard error of 0.072
    assert 0.8 < np.mean(z**2) < 1.25


def test_weighted_mean_is_least_squares():
    rng = np.random.default_rng(3)
    gain = rng.normal(size=5) + 1j * rng.normal(size=5)
    aligned = rng.normal(size=(5, 4)) + 1j * rng.normal(size=(5, 4))
    expected = np.linalg.lstsq(gain[:, None], aligned, rcond=None)[0][0]
    np.testing.assert_allclose(weighted_mean(aligned, gain), expected, rtol=1e-12)
