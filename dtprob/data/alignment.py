"""Bring repeated packets of one channel to a common phase, gain and delay.

A receiver that samples on its own clock sees the same response h(f) in every packet i as

    X_i(f) = a_i exp(-j 2 pi f tau_i) h(f) + noise,

with an unknown complex gain a_i and an unknown delay tau_i of fractions of a sample. Both are found
together with h by least squares: h from the aligned packets, then each packet's (a_i, tau_i) given h, until
nothing moves. Each step lowers the sum of squares. A delay is found on a grid first, so a packet that was
cut out samples early or late is not left in a wrong optimum.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float


class Alignment(NamedTuple):
    """Packets brought together.

    Attributes:
        response: the common response, of mean power 1 over the subcarriers.
        gain: what each packet's response has to be multiplied with to give the packet.
        delay: each packet's delay, s, relative to ``response``.
        aligned: the packets with their delays taken out, gains left in.
        residual: the share of each packet's energy that the common response does not explain.
    """

    response: Complex[np.ndarray, " subcarrier"]
    gain: Complex[np.ndarray, " packet"]
    delay: Float[np.ndarray, " packet"]
    aligned: Complex[np.ndarray, "packet subcarrier"]
    residual: Float[np.ndarray, " packet"]


def align(
    packets: Complex[np.ndarray, "packet subcarrier"],
    frequency: Float[np.ndarray, " subcarrier"],
    *,
    reach: float,
    iterations: int = 40,
    tolerance: float = 1e-8,
) -> Alignment:
    """Estimate a common response and every packet's complex gain and delay by least squares.

    The common phase and delay that no data can tell are fixed by the packet that starts the iteration, the
    one that most resembles the others: its gain starts real and its delay zero.

    Args:
        packets: frequency responses of repeated packets.
        frequency: Hz.
        reach: the largest delay between packets that is looked for, s.
        iterations: the largest number of alternations.
        tolerance: stop when the mean residual share falls by less than this.
    """
    omega = 2.0 * np.pi * frequency
    fit = _start(packets, omega, reach)
    for _ in range(iterations):
        response = weighted_mean(fit.aligned, fit.gain)
        response = response / np.sqrt(np.mean(np.abs(response) ** 2))
        before = np.mean(fit.residual)
        fit = _fit(packets, response, omega, fit.delay)
        if before - np.mean(fit.residual) < tolerance:
            break
    return fit


def weighted_mean(
    aligned: Complex[np.ndarray, "packet subcarrier"], gain: Complex[np.ndarray, " packet"]
) -> Complex[np.ndarray, " subcarrier"]:
    """The least-squares common response of aligned packets, given their gains."""
    return gain.conj() @ aligned / np.sum(np.abs(gain) ** 2)


def _start(
    packets: Complex[np.ndarray, "packet subcarrier"], omega: Float[np.ndarray, " subcarrier"], reach: float
) -> Alignment:
    """Align to one packet: of some spread over the record, the one with the smallest median residual."""
    step = _step(omega)
    grid = step * np.arange(-np.ceil(reach / step), np.ceil(reach / step) + 1)
    turn = np.exp(1j * np.outer(omega, grid))
    chosen = packets[np.unique(np.linspace(0, len(packets) - 1, 12).astype(int))]
    chosen = chosen / np.sqrt(np.mean(np.abs(chosen) ** 2, axis=1, keepdims=True))
    fits = [
        _fit(packets, candidate, omega, grid[np.argmax(np.abs((packets * candidate.conj()) @ turn), axis=1)])
        for candidate in chosen
    ]
    return min(fits, key=lambda fit: float(np.median(fit.residual)))


def _fit(
    packets: Complex[np.ndarray, "packet subcarrier"],
    response: Complex[np.ndarray, " subcarrier"],
    omega: Float[np.ndarray, " subcarrier"],
    delay: Float[np.ndarray, " packet"],
) -> Alignment:
    """Every packet's gain and delay, given the common response and a first guess of the delays."""
    delay = _refine(packets * response.conj(), omega, delay)
    aligned = packets * np.exp(1j * omega * delay[:, None])
    energy = np.sum(np.abs(response) ** 2)
    gain = aligned @ response.conj() / energy
    explained = np.abs(gain) ** 2 * energy / np.sum(np.abs(packets) ** 2, axis=1)
    return Alignment(response, gain, delay, aligned, 1.0 - explained)


def _refine(
    product: Complex[np.ndarray, "packet subcarrier"],
    omega: Float[np.ndarray, " subcarrier"],
    delay: Float[np.ndarray, " packet"],
) -> Float[np.ndarray, " packet"]:
    """Newton's method for the delay that maximises |sum_k product_k exp(j omega_k delay)|."""
    moments = np.stack([np.ones_like(omega), omega, omega**2], axis=1)
    for _ in range(3):
        turned = product * np.exp(1j * omega * delay[:, None])
        value, first, second = np.einsum("pk,km->mp", turned, moments)
        gradient = -2.0 * (value.conj() * first).imag
        hessian = 2.0 * (np.abs(first) ** 2 - (value.conj() * second).real)
        newton = -gradient / np.where(hessian < 0.0, hessian, -np.inf)
        delay = delay + np.clip(newton, -_step(omega), _step(omega))
    return delay


def _step(omega: Float[np.ndarray, " subcarrier"]) -> float:
    """A step that does not leave the hill of the objective one stands on, s."""
    return 0.25 * np.pi / float(np.max(np.abs(omega)))
