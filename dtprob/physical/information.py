"""How much data tell of an effect: twice the expected gain in log-likelihood over the best base model.

Convention, for complex data y ~ CN(mu, s2) with independent entries (real and imaginary part of variance s2 /
2 each): a mean that differs by d from the base model's gives lambda = 2 |(I - P) d|^2 / s2, with P the
projection, in the real stacked space, on what the base model's free parameters can mimic. The number of
parameters is not subtracted, the noise level counts as known for effects on the mean, and as fitted for
effects on the noise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Complex, Float
from scipy import integrate

from dtprob.errors import InputError


def mean_information(
    difference: Complex[np.ndarray, " entry"],
    tangents: Complex[np.ndarray, "nuisance entry"],
    noise_power: float,
    precision: Float[np.ndarray, " nuisance"] | None = None,
) -> float:
    """Lambda of a change of the mean.

    Args:
        difference: mean with the effect minus mean without.
        tangents: derivative of the mean by each free parameter of the base model.
        noise_power: E |noise|^2 per entry.
        precision: prior precision of each free parameter; none when None.
    """
    left = projected(difference, tangents, noise_power, precision)
    return max(0.0, float(2 * (_stack(difference) @ left) / noise_power))


def projected(
    difference: Complex[np.ndarray, " entry"],
    tangents: Complex[np.ndarray, "nuisance entry"],
    noise_power: float,
    precision: Float[np.ndarray, " nuisance"] | None = None,
) -> Float[np.ndarray, " twice"]:
    """What is left of a change of the mean, (I - P) d, real and imaginary parts stacked.

    The arguments are those of `mean_information`; where parameters have a prior, P is the ridge projection.
    """
    d = _stack(difference)
    if not len(tangents):
        return d
    basis, gram = _basis(tangents, noise_power, precision)
    return d - np.linalg.solve(gram, basis @ d) @ basis


def _basis(
    tangents: Complex[np.ndarray, "nuisance entry"],
    noise_power: float,
    precision: Float[np.ndarray, " nuisance"] | None,
) -> tuple[Float[np.ndarray, "nuisance twice"], Float[np.ndarray, "nuisance nuisance"]]:
    """The tangents of unit length, and the matrix of the normal equations of a fit by them."""
    basis = _stack(tangents)
    scale = np.linalg.norm(basis, axis=1)
    scale = np.where(scale > 0, scale, 1.0)
    basis = basis / scale[:, None]
    gram = basis @ basis.T
    prior = np.zeros(len(scale)) if precision is None else precision * noise_power / 2 / scale**2
    gram[np.diag_indices_from(gram)] += prior + 1e-12
    return basis, gram


def spread_information(
    columns: Complex[np.ndarray, "block component entry"],
    tangents: Complex[np.ndarray, "nuisance whole"],
    noise_power: float,
    precision: Float[np.ndarray, " nuisance"] | None = None,
) -> float:
    """Lambda of a random change of the mean: sum of columns, each times an independent real standard normal.

    With U the columns over the standard deviation of the noise and I - P what is left beside the base model's free
    parameters, it follows from the trace and the determinant of I + U^T (I - P) U. Neither needs a matrix that is
    larger than the number of components of a block, or of parameters.

    Args:
        columns: per independent block of the data, what one unit of each random component adds; the blocks one after the
            other are all the data.
        tangents: derivative of the mean by each free parameter of the base model.
        noise_power: E |noise|^2 per entry.
        precision: prior precision of each free parameter; none when None.
    """
    blocks, components, entries = columns.shape
    stacked = _stack(columns) / np.sqrt(noise_power / 2)
    alone = stacked @ np.swapaxes(stacked, 1, 2)
    trace = float(np.trace(alone, axis1=1, axis2=2).sum())
    alone += np.eye(components)
    determinant = float(np.linalg.slogdet(alone)[1].sum())
    if len(tangents):
        basis, gram = _basis(tangents, noise_power, precision)
        parts = _stack(_complex(basis).reshape(len(basis), blocks, entries)).swapaxes(0, 1)
        shared = stacked @ np.swapaxes(parts, 1, 2)
        hidden = np.einsum("bcn,bcm->nm", shared, shared)
        left = gram - np.einsum("bcn,bcm->nm", shared, np.linalg.solve(alone, shared))
        trace -= float(np.trace(np.linalg.solve(gram, hidden)))
        determinant += float(np.linalg.slogdet(left)[1] - np.linalg.slogdet(gram)[1])
    count = 2 * blocks * entries
    return max(0.0, float(count * np.log1p(max(0.0, trace) / count) - determinant))


def power_information(power: Float[np.ndarray, "..."]) -> float:
    """Lambda of noise whose power differs from entry to entry, against one level."""
    return float(2 * power.size * (np.log(np.mean(power)) - np.mean(np.log(power))))


def colour_information(covariance: Complex[np.ndarray, "n n"], blocks: int) -> float:
    """Lambda of correlated noise in `blocks` independent blocks, against white noise of the best level."""
    eigenvalues = np.linalg.eigvalsh(covariance)
    return 2 * blocks * float(len(eigenvalues) * np.log(np.mean(eigenvalues)) - np.sum(np.log(eigenvalues)))


def impulse_information(probability: float, ratio: float, count: int) -> float:
    """Lambda of noise that is at times (1 + ratio) times as strong, against Gaussian noise of its power."""
    if probability <= 0 or ratio <= 0:
        return 0.0
    weights, powers = np.array([1 - probability, probability]), np.array([1.0, 1 + ratio])
    level = float(weights @ powers)

    def integrand(log_square: float) -> float:
        u = np.exp(log_square)
        logs = np.log(weights) - np.log(powers) - u / powers
        density = np.logaddexp(logs[0], logs[1])
        return float(np.exp(density + log_square) * (density + np.log(level) + u / level))

    top = np.log(60 * powers[1])
    value, _ = integrate.quad(integrand, -35.0, top, limit=400, points=[0.0, float(np.log(powers[1]))])
    return 2 * count * max(0.0, float(value))


def size_for(
    target: float,
    information: Callable[[float], float],
    *,
    limit: float,
    start: float | None = None,
    tolerance: float = 0.02,
    evaluations: int = 24,
) -> tuple[float, float]:
    """The size of an effect at which its lambda is `target`.

    Follows the local power law from `start`, and halves the bracket where that leaves it. Lambda need not be
    monotone; any size whose lambda is right will do.

    Args:
        target: the lambda wanted, positive.
        information: lambda of a size.
        limit: the largest size that makes sense.
        start: where to look first; a thousandth of `limit` when None.
        tolerance: accepted relative error of lambda.
        evaluations: how often `information` may be called.

    Returns:
        the size and its lambda, the closest found.

    Raises:
        InputError: the effect at its limit is not that informative.
    """
    size = limit * 1e-3 if start is None else start
    low, high = 0.0, np.inf
    best = (size, 0.0)
    power = 2.0
    previous: tuple[float, float] | None = None
    for _ in range(evaluations):
        found = information(size)
        if best[1] == 0 or abs(np.log(max(found, 1e-300) / target)) < abs(
            np.log(max(best[1], 1e-300) / target)
        ):
            best = (size, found)
        if abs(found / target - 1) <= tolerance:
            return best
        low, high = (size, high) if found < target else (low, size)
        if found < target and size >= limit:
            raise InputError(
                "target lambda",
                f"at most {found:.3g}, what the largest size gives",
                f"{target:g}",
                "Ask for less",
            )
        power = _slope(previous, (size, found), power)
        previous = (size, found)
        guess = size * (target / max(found, 1e-12 * target)) ** (1 / power)
        size = _inside(guess, low, high, limit)
    return best


def _slope(previous: tuple[float, float] | None, current: tuple[float, float], default: float) -> float:
    """Exponent of the power law through two points, kept within reason."""
    if previous is None or min(previous[1], current[1]) <= 0 or previous[0] == current[0]:
        return default
    slope = np.log(current[1] / previous[1]) / np.log(current[0] / previous[0])
    return float(np.clip(slope, 0.5, 8.0)) if np.isfinite(slope) and slope > 0 else default


def _inside(guess: float, low: float, high: float, limit: float) -> float:
    if np.isinf(high):
        return min(guess, limit)
    margin = 0.02 * (high - low)
    return guess if low + margin < guess < high - margin else (low + high) / 2


def _complex(stacked: Float[np.ndarray, "*rows twice"]) -> Complex[np.ndarray, "*rows entry"]:
    real, imaginary = np.split(stacked, 2, axis=-1)
    return real + 1j * imaginary


def _stack(values: Complex[np.ndarray, "*rows entry"]) -> Float[np.ndarray, "*rows twice"]:
    return np.concatenate([np.real(values), np.imag(values)], axis=-1)
