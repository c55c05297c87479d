"""Tail probabilities of score statistics, far beyond where they underflow, and of the smallest of many."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

LOG_SMALLEST: Final = -660.0
"""Logarithms below this are not turned into probabilities."""
_LEVELS: Final = np.array([0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5])
_BELOW: Final = 4
"""Replicates below a quantile that are enough to estimate it."""


def family_wise(p: np.ndarray, replicate_p: np.ndarray) -> np.ndarray:
    """Family-wise p-values by min-p: Sidak's form with the effective number of tests that the replicates show."""
    return any_of(p, effective_tests(replicate_p))


def any_of(p: np.ndarray, tests: float) -> np.ndarray:
    """Sidak's p-values of the smallest of so many independent tests."""
    return -np.expm1(tests * np.log1p(-np.minimum(p, 1 - 1e-16)))


def effective_tests(replicate_p: np.ndarray) -> float:
    """Number of independent tests whose smallest p-value is distributed as that of the replicates.

    Far out there may be more of them than near the middle, so the level is looked at too where there are the replicates.
    """
    told = _LEVELS[(_LEVELS * len(replicate_p) >= _BELOW) | (_LEVELS.max() == _LEVELS)]
    quantiles = np.quantile(np.maximum(replicate_p, 1e-300), told)
    effective = np.log1p(-told) / np.log1p(-np.minimum(quantiles, 1 - 1e-12))
    return float(np.clip(np.max(effective), 1.0, 1e6))


def deviation(p: ArrayLike, *, one_sided: bool) -> np.ndarray:
    """Standard deviations from 0 at which a normal score has a p-value; at least 0 if it is two-sided."""
    tail = np.asarray(p) / (1 if one_sided else 2)
    return normal_quantile(np.log(np.minimum(tail, 1 - 1e-16)))


def gamma_tail(observed: np.ndarray, mean: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Upper-tail p-value and normal quantile of a positive statistic with the given null mean and variance."""
    nothing, value, shape = _as_gamma(observed, mean, variance)
    log_p = np.where(nothing, 0.0, log_gamma_tail(value, shape))
    lower = special.ndtri_exp(np.log(np.maximum(special.gammainc(shape, value), 1e-300)))
    quantile = np.where((log_p > np.log(0.5)) & ~nothing, lower, normal_quantile(log_p))
    return np.exp(np.maximum(log_p, LOG_SMALLEST)), quantile


def gamma_log_tail(observed: np.ndarray, mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Log upper-tail p-value of a positive statistic with the given null mean and variance; 0 where the mean is 0."""
    nothing, value, shape = _as_gamma(observed, mean, variance)
    return np.where(nothing, 0.0, log_gamma_tail(value, shape))


def _as_gamma(
    observed: np.ndarray, mean: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the mean is 0, and the value and the shape of a unit gamma elsewhere."""
    nothing = mean <= 0
    mean, variance = (
        np.where(nothing, 1.0, mean),
        np.where(nothing, 1.0, np.maximum(variance, 1e-12 * mean**2)),
    )
    return nothing, np.where(nothing, 1.0, observed) * mean / variance, mean**2 / variance


_MOST_SKEW: Final = 1.7
"""Skewness of what is taken as Gumbel, whose own is 1.14."""
_ALIKE: Final = 1e-9
"""Spread over mean up to which replicates are alike."""


class Moments(NamedTuple):
    """Mean, variance and third central moment of what each value is compared with."""

    mean: np.ndarray
    variance: np.ndarray
    third: np.ndarray

    @property
    def is_too_skew(self) -> np.ndarray:
        """Whether it is more skew than a Gumbel variable, or all alike but for rounding."""
        spread = np.sqrt(self.variance)
        return (spread <= _ALIKE * np.abs(self.mean)) | (self.third >= _MOST_SKEW * spread**3)


def moments_of_others(values: np.ndarray) -> Moments:
    """Moments of the replicates that each of the values (replicate + 1,) is compared with, those of the data being last.

    A replicate is compared with the others, as the data are with all: judged by moments that it is part of, none could be
    as far out as the data can.
    """
    n = len(values) - 1
    centred = values[:-1] - values[:-1].mean()
    count, own = np.append(np.full(n, max(n - 1, 1)), n), np.append(centred, 0.0)
    first, second, third = ((np.sum(centred**k) - own**k) / count for k in (1, 2, 3))
    variance = np.maximum(second - first**2, 0.0)
    return Moments(values[:-1].mean() + first, variance, third - 3 * first * second + 2 * first**3)


def largest_tail(largest: np.ndarray) -> np.ndarray:
    """Upper-tail p-values of the largest of many squared scores over variances: of replicates, and of the data, last.

    They are taken as Gumbel, which the largest square of many normal scores is; where the replicates are more skew, their
    roots are. Where these are, too, as of rare outcomes, or all alike, nothing is said.
    """
    found = np.ones_like(largest)
    for values in (np.sqrt(largest), largest):
        others = moments_of_others(values)
        tail = _gumbel_tail(values, others.mean, np.sqrt(others.variance))
        found = np.where(others.is_too_skew, found, tail)
    return found


def beyond_largest(values: np.ndarray, null: np.ndarray) -> np.ndarray:
    """Upper-tail p-values of values, each the largest of many, against those of replicates; as in `largest_tail`."""
    for seen, replicates in ((values, null), (np.sqrt(values), np.sqrt(null))):
        found = Moments(*(moment[-1] for moment in moments_of_others(np.append(replicates, 0.0))))
        if not found.is_too_skew:
            return _gumbel_tail(seen, found.mean, np.sqrt(found.variance))
    return np.ones_like(values)


def _gumbel_tail(values: np.ndarray, mean: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Upper-tail p-values of Gumbel variables of a mean and a standard deviation."""
    scale = np.maximum(spread * np.sqrt(6.0) / np.pi, 1e-12)
    log_rate = -(values - mean) / scale - np.euler_gamma
    return np.maximum(-np.expm1(-np.exp(np.minimum(log_rate, 30.0))), np.exp(LOG_SMALLEST))


def variance_ratio_tail(
    observed: np.ndarray, mean: ArrayLike, variance: ArrayLike, replicates: int
) -> np.ndarray:
    """Upper-tail p-values of sums of squares, each over its variance in so many replicates: an F distribution.

    Args:
        observed: the sums.
        mean: of the sum over replicates, above 0.
        variance: likewise; with the mean it tells how many independent squares there are.
        replicates: from which the variance of each square was taken.
    """
    mean = np.asarray(mean)
    squares = 2 * mean**2 / np.maximum(variance, 1e-12 * mean**2)
    p = special.fdtrc(squares, replicates * np.maximum(squares, 1.0), observed / mean)
    return np.maximum(p, np.exp(LOG_SMALLEST))


def log_gamma_tail(value: np.ndarray, shape: np.ndarray | float) -> np.ndarray:
    """Log upper-tail probability of a unit gamma, by its asymptote where the probability underflows."""
    p = special.gammaincc(shape, value)
    far = (shape - 1) * np.log(np.maximum(value, 1e-300)) - value - special.gammaln(shape)
    return np.where(p > 0, np.log(np.where(p > 0, p, 1.0)), far)


def field_log_bayes_factor(observed: np.ndarray, mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Rough log Bayes factor of a random field, from the energy of its scores: nu/2 (r - 1 - log r) - log(nu)/2."""
    safe = np.maximum(mean, 1e-300)
    nu, ratio = 2 * safe**2 / np.maximum(variance, 1e-12 * safe**2), np.maximum(observed / safe, 1.0)
    return np.where(mean > 0, nu / 2 * (ratio - 1 - np.log(ratio)) - np.log(nu) / 2, -np.inf)


def normal_quantile(log_p: np.ndarray) -> np.ndarray:
    """Normal quantile of an upper-tail probability given by its logarithm."""
    return -special.ndtri_exp(log_p)


def told_apart(value: float) -> float:
    """Six digits of a number: what rounding alone parts is equal."""
    return float(f"{value:.6g}")
