"""Noise laws against their moments, and waveforms against what they are."""

import dataclasses

import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.physical import disturbances, front_end
from dtprob.physical.channel import Sounding, mean_power, subcarriers
from dtprob.physical.impairment import thermal
from dtprob.physical.information import power_information
from dtprob.physical.noise import rounding
from dtprob.physical.waveform import chirp, resample, symmetric_pilot, to_frequency, to_time

SHAPE = (40, 3, 4, 2, 16)
SOUNDING = Sounding(subcarriers(16, 100e6), 1e-3 * np.arange(3))


def noise_of(law, seed=0):
    return law.measure(np.random.default_rng(seed), np.zeros(SHAPE, complex), SOUNDING)


def test_thermal_noise_is_circular_and_white():
    found = noise_of(thermal(3.0))
    assert mean_power(found) == pytest.approx(3, rel=0.03)
    assert abs(np.mean(found**2)) < 0.1
    assert abs(np.mean(found[..., 1:] * found[..., :-1].conj())) < 0.1


@pytest.mark.parametrize("count", [15, 16])
def test_time_and_frequency_are_unitary_inverses(count):
    sounding = Sounding(subcarriers(count, 1e8), np.zeros(1))
    rng = np.random.default_rng(0)
    spectrum = rng.standard_normal((3, count)) + 1j * rng.standard_normal((3, count))
    wave = to_time(spectrum, sounding)
    np.testing.assert_allclose(np.sum(np.abs(wave) ** 2), np.sum(np.abs(spectrum) ** 2))
    np.testing.assert_allclose(to_frequency(wave, sounding), spectrum, atol=1e-12)
    np.testing.assert_allclose(resample(wave, sounding, sounding.sample_time), wave, atol=1e-12)
    whole = sounding.sample_time + 1 / sounding.spacing
    sign = -1 if count % 2 == 0 else 1
    np.testing.assert_allclose(resample(wave, sounding, whole), sign * wave, atol=1e-9)


@pytest.mark.parametrize("count", [8, 16, 31])
def test_pilots(count):
    sounding = Sounding(subcarriers(count, 1e8), np.zeros(1))
    np.testing.assert_allclose(np.abs(chirp(count)), 1)
    np.testing.assert_allclose(np.abs(to_time(chirp(count), sounding)), 1, atol=1e-9)
    pilot = symmetric_pilot(np.random.default_rng(0), count)
    np.testing.assert_array_equal(pilot, pilot[::-1])
    assert set(pilot) <= {-1.0, 1.0}


def test_impulses_add_their_share():
    law = dataclasses.replace(thermal(1.0), impulse_probability=0.05, impulse_ratio=40.0)
    found = noise_of(law)
    assert mean_power(found) == pytest.approx(3, rel=0.1)
    assert law.mean_power(SHAPE) == pytest.approx(3)
    assert np.mean(np.abs(found) ** 4) > 5 * mean_power(found) ** 2


def test_correlated_noise_has_the_covariance_of_its_filter():
    made = disturbances.correlated_noise().noise
    assert made is not None
    found = noise_of(made(thermal(2.0), np.zeros(SHAPE), SOUNDING, 0.7)).reshape(-1, 16)
    covariance = found.T @ found.conj() / len(found)
    index = np.arange(16)
    np.testing.assert_allclose(covariance, 2 * 0.7 ** np.abs(index[:, None] - index), atol=0.35)
    assert np.mean(np.diag(covariance).real) == pytest.approx(2, rel=0.05)


def test_coloured_noise_keeps_its_mean_and_peaks_at_its_centre():
    made = disturbances.colored_noise(20e6).noise
    assert made is not None
    law = made(thermal(1.0), np.zeros(SHAPE), SOUNDING, 3.0)
    power = np.mean(np.abs(noise_of(law)) ** 2, axis=(0, 1, 2, 3))
    assert law.mean_power(SHAPE) == pytest.approx(1)
    peak = SOUNDING.subcarrier_frequency[np.argmax(power)]
    assert abs(peak - 20e6) < 12e6
    np.testing.assert_allclose(power, np.broadcast_to(law.power, (1, 1, 1, 1, 16)).reshape(-1), rtol=0.2)


def test_interference_is_where_it_is():
    links, snapshots, band = np.arange(40) < 10, np.array([True, False, False]), np.arange(16) == 5
    made = disturbances.interference(links, snapshots, band).noise
    assert made is not None
    found = np.abs(noise_of(made(thermal(1.0), np.zeros(SHAPE), SOUNDING, 99.0))) ** 2
    assert found[:10, 0, ..., 5].mean() == pytest.approx(100, rel=0.3)
    found[:10, 0, ..., 5] = 1
    assert found.mean() == pytest.approx(1, rel=0.03)


def test_quantization_adds_the_power_of_its_step():
    made = front_end.quantization().noise
    assert made is not None
    rng = np.random.default_rng(1)
    channel = rng.standard_normal(SHAPE) + 1j * rng.standard_normal(SHAPE)
    law = made(thermal(0.01), channel, SOUNDING, 0.4)
    error = law.measure(rng, channel, SOUNDING) - channel
    assert mean_power(error) == pytest.approx(law.mean_power(SHAPE), rel=0.05)
    assert law.mean_power(SHAPE) == pytest.approx(0.01 + 0.16 * mean_power(channel) / 6, rel=0.01)


@pytest.mark.parametrize("size", [0.05, 0.3, 0.8, 1.5])
def test_rounding_shifts_the_mean_and_leaves_a_variance(size):
    rng = np.random.default_rng(2)
    channel = rng.standard_normal((2, 1, 1, 2, 16)) + 1j * rng.standard_normal((2, 1, 1, 2, 16))
    made = front_end.quantization().noise
    assert made is not None
    law = made(thermal(0.04), channel, SOUNDING, size)
    found = np.stack([law.measure(rng, channel, SOUNDING) for _ in range(2000)]) - channel
    shift, variance = rounding(channel, law.power, law.step, SOUNDING)
    deviation = np.sqrt(variance / 2000)
    assert np.max(np.abs(found.mean(axis=0) - shift) / deviation) < 4
    seen = np.mean(found.var(axis=0), axis=-1, keepdims=True)
    np.testing.assert_allclose(seen, variance, rtol=0.1)


def test_a_coarse_step_tells_by_the_shift_that_repeats():
    """Links of one level have noise of one level; what is left is twice the square of the shift over the noise."""
    rng = np.random.default_rng(3)
    channel = np.exp(2j * np.pi * rng.random((20, 2, 1, 1, 16)))
    made = front_end.quantization().noise
    assert made is not None
    law = made(thermal(0.02), channel, SOUNDING, 0.3)  # three deviations of each branch
    shift, variance = rounding(channel, law.power, law.step, SOUNDING)
    none = np.zeros((0, channel.size), complex)
    told = 2 * np.sum(np.abs(shift) ** 2) / np.mean(variance)
    scatter = power_information(np.broadcast_to(variance, channel.shape))
    assert told > 3
    assert law.information(channel, SOUNDING, none) == pytest.approx(told + scatter, rel=0.05)
    known = shift.reshape(1, -1)
    assert law.information(channel, SOUNDING, known) == pytest.approx(scatter, abs=1e-3)


def test_a_quantized_link_has_few_levels():
    made = front_end.quantization().noise
    assert made is not None
    channel = np.ones((1, 1, 1, 1, 16), complex)
    law = made(thermal(0.2), channel, SOUNDING, 1.0)
    wave = to_time(law.measure(np.random.default_rng(0), channel, SOUNDING), SOUNDING)
    np.testing.assert_allclose(wave.real, np.round(wave.real), atol=1e-12)


def test_soundings_are_symmetric():
    with pytest.raises(InputError, match="symmetric"):
        Sounding(np.arange(4.0), np.zeros(1))
