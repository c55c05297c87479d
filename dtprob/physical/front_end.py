"""Impairments of the front end: what radio parts, clocks and converters do to the received waveform.

Each acts on the samples of the sounding symbol in time, where the hardware does, and the channel estimate is
what the receiver then finds on dividing by its pilots.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Complex, Float

from dtprob.physical.channel import Sounding, mean_power, synthesise
from dtprob.physical.impairment import Channel, Columns, Impairment
from dtprob.physical.noise import Noise
from dtprob.physical.rays import Rays
from dtprob.physical.waveform import resample, to_frequency, to_time
from dtprob.physical.world import World


def timing_offset(limit: float = 1e-7) -> Impairment:
    """The waveform comes late by `size` seconds: it is interpolated at instants that much earlier."""

    def late(_world: World, channel: Channel, sounding: Sounding, size: float) -> Channel:
        wave = to_time(channel, sounding)
        return to_frequency(resample(wave, sounding, sounding.sample_time - size), sounding)

    return Impairment("timing_offset", "s", limit, channel=late)


def sampling_clock_offset(limit: float = 1e-2) -> Impairment:
    """The delay grows by `size` seconds in a second, within the symbol and from snapshot to snapshot."""

    def drift(_world: World, channel: Channel, sounding: Sounding, size: float) -> Channel:
        wave = to_time(channel, sounding)
        instant = sounding.sample_time * (1 - size) - size * sounding.snapshot_time[:, None, None, None]
        return to_frequency(resample(wave, sounding, np.broadcast_to(instant, wave.shape)), sounding)

    return Impairment("sampling_clock_offset", "1", limit, channel=drift)


def carrier_frequency_offset(limit: float = 1e6) -> Impairment:
    """The local oscillators differ by `size` Hz; the waveform rotates continuously, inside symbols too."""

    def rotate(_world: World, channel: Channel, sounding: Sounding, size: float) -> Channel:
        wave = to_time(channel, sounding)
        time = sounding.snapshot_time[:, None, None, None] + sounding.sample_time
        return to_frequency(wave * np.exp(2j * np.pi * size * time), sounding)

    return Impairment("carrier_frequency_offset", "Hz", limit, channel=rotate)


def iq_imbalance(
    direction: tuple[float, float], pilot: Float[np.ndarray, " subcarrier"], limit: float = 1.0
) -> Impairment:
    """The quadrature branches of the receiver differ in gain and phase, by size times a direction.

    Args:
        direction: of gain (a fraction) and phase (rad).
        pilot: real known symbols, equal on subcarriers that mirror each other.
        limit: of the size.
    """

    def mix(_world: World, channel: Channel, sounding: Sounding, size: float) -> Channel:
        wave = to_time(channel * pilot, sounding)
        gain, angle = size * direction[0] / 2, size * direction[1] / 2
        real, imaginary = np.real(wave), np.imag(wave)
        in_phase = (1 + gain) * (real * np.cos(angle) - imaginary * np.sin(angle))
        quadrature = (1 - gain) * (imaginary * np.cos(angle) - real * np.sin(angle))
        return to_frequency(in_phase + 1j * quadrature, sounding) / pilot

    detail = {"gain": direction[0], "phase": direction[1]}
    return Impairment("iq_imbalance", "1", limit, channel=mix, detail=detail)


def amplifier_nonlinearity(
    smoothness: float, pilot: Complex[np.ndarray, " subcarrier"] | None = None, limit: float = 3.0
) -> Impairment:
    """The receiving amplifier saturates.

    Rapp's law, r -> r / (1 + (r / r_sat)^(2 p))^(1 / 2 p). Size is the ratio of the campaign's root mean
    square amplitude to r_sat. Source: Rapp, 2nd European Conference on Satellite Communications, 1991.

    Args:
        smoothness: p.
        pilot: symbols sent on all subcarriers at once; None for a sounder that steps from tone to tone, whose
            amplifier sees one subcarrier at a time.
        limit: of the size.
    """

    def compress(_world: World, channel: Channel, sounding: Sounding, size: float) -> Channel:
        wave = channel if pilot is None else to_time(channel * pilot, sounding)
        drive = size * np.abs(wave) / np.sqrt(mean_power(channel))
        wave = wave * (1 + drive ** (2 * smoothness)) ** (-1 / (2 * smoothness))
        return wave if pilot is None else to_frequency(wave, sounding) / pilot

    detail = {"smoothness": smoothness, "sounder": "stepped" if pilot is None else "multitone"}
    return Impairment("amplifier_nonlinearity", "1", limit, channel=compress, detail=detail)


def frequency_response(order: int, limit: float = 0.9) -> Impairment:
    """The receiver's filter is a Butterworth low-pass, whose delay at the carrier was calibrated out.

    Args:
        order: of the low-pass.
        limit: of the size, half the bandwidth over the corner frequency.
    """

    def filtered(_world: World, channel: Channel, sounding: Sounding, size: float) -> Channel:
        angles = np.pi * (2 * np.arange(order) + 1 + order) / (2 * order)
        poles = np.exp(1j * angles)
        relative = size * sounding.subcarrier_frequency / (sounding.bandwidth / 2)
        response = np.prod(-poles / (1j * relative[:, None] - poles), axis=1)
        delay = float(np.sum(np.real(-1 / poles)))
        return channel * response * np.exp(1j * relative * delay)

    return Impairment("frequency_response", "1", limit, channel=filtered, detail={"order": order})


def frequency_ripple(delay: float, limit: float = 0.9) -> Impairment:
    """A mismatched cable echoes: the waveform comes again, with the fraction `size` of its amplitude."""

    def echo(_world: World, channel: Channel, sounding: Sounding, size: float) -> Channel:
        wave = to_time(channel, sounding)
        return to_frequency(wave + size * resample(wave, sounding, sounding.sample_time - delay), sounding)

    return Impairment("frequency_ripple", "1", limit, channel=echo, detail={"delay": delay})


def crosstalk(phase: float, delay: float, limit: float = 3.0) -> Impairment:
    """The transmitter leaks into the receiver past the antennas; size is the leak over the rms channel."""

    def leak(_world: World, channel: Channel, sounding: Sounding, size: float) -> Channel:
        tone = np.exp(1j * phase - 2j * np.pi * sounding.subcarrier_frequency * delay)
        return channel + size * np.sqrt(mean_power(channel)) * tone

    return Impairment("crosstalk", "1", limit, channel=leak, detail={"phase": phase, "delay": delay})


def gain_offset(limit: float = 20.0) -> Impairment:
    """The receiver's gain is off by `size` dB."""
    return Impairment(
        "gain_offset",
        "dB",
        limit,
        channel=lambda _world, channel, _sounding, size: channel * 10 ** (size / 20),
    )


def carrier_phase(limit: float = 3.0) -> Impairment:
    """The oscillators differ by a constant phase; size in rad."""
    return Impairment(
        "carrier_phase",
        "rad",
        limit,
        channel=lambda _world, channel, _sounding, size: channel * np.exp(1j * size),
    )


def packet_phase(angles: Float[np.ndarray, "link snapshot"]) -> Impairment:
    """Every packet has a phase of its own, size times the angle given; size 1 is that angle."""
    return Impairment(
        "packet_phase",
        "1",
        1.0,
        channel=lambda _world, channel, _sounding, size: (
            channel * np.exp(1j * size * angles)[:, :, None, None, None]
        ),
    )


def gain_drift(settling: float, limit: float = 2.0) -> Impairment:
    """The gain settles as the receiver warms up, 1 + size (1 - exp(-t / settling)); size is a pure number."""

    def warm(_world: World, channel: Channel, sounding: Sounding, size: float) -> Channel:
        elapsed = sounding.snapshot_time - sounding.snapshot_time[0]
        return channel * (1 + size * -np.expm1(-elapsed / settling))[:, None, None, None]

    return Impairment("gain_drift", "1", limit, channel=warm, detail={"settling": settling})


def phase_noise(
    draw: Float[np.ndarray, "link snapshot sample"], loop: float, limit: float = 1.0
) -> Impairment:
    """A locked oscillator's phase wanders about zero, anew on every link; size is its deviation in rad.

    Args:
        draw: standard normal steps, in time order.
        loop: bandwidth of the phase-locked loop, Hz; deviations are forgotten after 1 / (2 pi loop) seconds.
        limit: of the size.
    """

    def wander(_world: World, channel: Channel, sounding: Sounding, size: float) -> Channel:
        kept = np.exp(-2 * np.pi * loop * _gaps(sounding)).reshape(-1)
        kept[0] = 0.0
        return _turned(channel, sounding, size * _recursion(kept, np.sqrt(1 - kept**2), draw))

    def spread(world: World, rays: Rays, sounding: Sounding, size: float) -> Columns:
        return _common_phase(size * np.eye(len(sounding.snapshot_time)), synthesise(world, rays, sounding))

    return Impairment("phase_noise", "rad", limit, channel=wander, spread=spread, detail={"loop": loop})


def carrier_phase_drift(draw: Float[np.ndarray, "link snapshot sample"], limit: float = 1.0) -> Impairment:
    """A free-running oscillator's phase walks at random from the first sample on, anew on every link.

    Size is the standard deviation of the walk in rad after the time between the first two snapshots.

    Args:
        draw: standard normal steps, in time order.
        limit: of the size.
    """

    def walk(_world: World, channel: Channel, sounding: Sounding, size: float) -> Channel:
        gaps = _gaps(sounding).reshape(-1)
        step = np.sqrt(gaps / _interval(sounding))
        step[0] = 0.0
        return _turned(channel, sounding, size * _recursion(np.ones(len(step)), step, draw))

    def spread(world: World, rays: Rays, sounding: Sounding, size: float) -> Columns:
        steps = np.diff(sounding.snapshot_time, prepend=sounding.snapshot_time[0]) / _interval(sounding)
        factor = np.tril(np.ones((len(steps), len(steps)))) * np.sqrt(steps)
        return _common_phase(size * factor, synthesise(world, rays, sounding))

    return Impairment("carrier_phase_drift", "rad", limit, channel=walk, spread=spread)


def _interval(sounding: Sounding) -> float:
    times = sounding.snapshot_time
    return float(times[1] - times[0]) if len(times) > 1 else 1.0


def _gaps(sounding: Sounding) -> Float[np.ndarray, "snapshot sample"]:
    """Time from the previous sample to each; 0 for the first of all."""
    times = sounding.snapshot_time[:, None] + sounding.sample_time
    return np.diff(times.reshape(-1), prepend=times.flat[0]).reshape(times.shape)


def _recursion(
    kept: Float[np.ndarray, " step"],
    added: Float[np.ndarray, " step"],
    draw: Float[np.ndarray, "link snapshot sample"],
) -> Float[np.ndarray, "link snapshot sample"]:
    """x_n = kept_n x_{n-1} + added_n w_n."""
    steps = (draw.reshape(len(draw), -1) * added).T
    state, found = np.zeros(len(draw)), np.empty(steps.shape)
    for index, step in enumerate(steps):
        state = kept[index] * state + step
        found[index] = state
    return found.T.reshape(draw.shape)


def _turned(
    channel: Channel, sounding: Sounding, phase: Float[np.ndarray, "link snapshot sample"]
) -> Channel:
    wave = to_time(channel, sounding)
    return to_frequency(wave * np.exp(1j * phase[:, :, None, None]), sounding)


def _common_phase(factor: Float[np.ndarray, "snapshot component"], channel: Channel) -> Columns:
    """What common phases of the snapshots, of covariance factor factor^T, add to each link."""
    each = 1j * np.einsum("sc,lsabk->lcsabk", factor, channel)
    return each.reshape(*each.shape[:2], -1)


def quantization(limit: float = 4.0) -> Impairment:
    """The converter rounds both branches to steps of `size` times the root mean square amplitude.

    Automatic gain sets the scale anew for every snapshot of every link.
    """

    def round_off(noise: Noise, channel: Channel, _sounding: Sounding, size: float) -> Noise:
        amplitude = np.sqrt(np.mean(np.abs(channel) ** 2, axis=(2, 3, 4), keepdims=True))
        return dataclasses.replace(noise, step=size * amplitude)

    return Impairment("quantization", "1", limit, noise=round_off)
