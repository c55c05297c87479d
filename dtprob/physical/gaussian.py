"""Gaussian measurements in independent blocks, faults that change their law, and how much a fault can be told by.

The base twin's law has a mean that is linear in free coefficients and a covariance with a few free parameters; both are
fitted, so that what they can imitate does not count.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from scipy import optimize, special

from dtprob.physical.information import size_for

type Vector = Float[np.ndarray, "block row"]
type Covariance = Float[np.ndarray, "block row row"]
type Tangents = Float[np.ndarray, "block row coefficient"]

_TOLERANCE: Final = 0.15
"""Relative error of lambda that counts as met."""
_WIDEST: Final = 6.0
"""How far the logarithms of the covariance's parameters may move."""
_STEP: Final = 1e-4
"""Of these logarithms, for derivatives."""
_LEAST: Final = 1e-6
"""Share of the variance of a measurement that is left at least."""


@dataclass(frozen=True)
class Law:
    """The law of all measurements, normal in each block but for a receiver that saturates.

    Attributes:
        mean: of each row, before the receiver.
        covariance: of each block, likewise.
        ceiling: the largest level that the receiver shows.
    """

    mean: Vector
    covariance: Covariance
    ceiling: float = field(default=np.inf, kw_only=True)


@dataclass(frozen=True)
class Bench:
    """A sound law, and what the base twin can fit.

    Attributes:
        law: of the measurements without a fault.
        tangents: by which the twin's mean moves with each free coefficient.
        family: covariance at the logarithms of its free parameters.
        start: these logarithms where `family` gives the sound law's covariance.
    """

    law: Law
    tangents: Tangents
    family: Callable[[np.ndarray], Covariance]
    start: np.ndarray


@dataclass(frozen=True)
class Fault:
    """One fault of a Gaussian measurement; of size 0 it changes nothing.

    Attributes:
        family: name of the physics.
        instance: which place, site or part; None where there is only one.
        unit: of the size.
        limit: largest size.
        change: (law, size) -> law.
        detail: what else the key tells of it.
    """

    family: str
    instance: str | None
    unit: str
    limit: float
    change: Callable[[Law, float], Law]
    detail: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """`family` or `family[instance]`."""
        return self.family if self.instance is None else f"{self.family}[{self.instance}]"


@dataclass(frozen=True)
class Sized:
    """A fault in a case: how large, and its information alone."""

    fault: Fault
    size: float
    lambda_: float

    def record(self) -> dict[str, Any]:
        """For the key."""
        fault = self.fault
        return {
            "name": fault.name,
            "family": fault.family,
            "instance": fault.instance,
            "size": self.size,
            "unit": fault.unit,
            "lambda": self.lambda_,
            "detail": dict(fault.detail),
        }


def shifted(shape: Vector) -> Callable[[Law, float], Law]:
    """A change that adds `shape` times the size to the mean."""
    return lambda law, size: replace(law, mean=law.mean + size * shape)


def louder(shape: Vector) -> Callable[[Law, float], Law]:
    """A change that multiplies the standard deviation of every row by exp(shape times the size)."""

    def change(law: Law, size: float) -> Law:
        factor = np.exp(size * shape)
        return replace(law, covariance=law.covariance * factor[:, :, None] * factor[:, None, :])

    return change


def shown(law: Law) -> Law:
    """The normal law with the moments of what the receiver shows.

    Mean and variance of what is cut off at a level are exact, covariances to first order in the correlation.

    Args:
        law: of the measurements.
    """
    if np.isinf(law.ceiling):
        return law
    deviation = np.sqrt(np.einsum("bii->bi", law.covariance))
    room = (law.ceiling - law.mean) / deviation
    below, density = special.ndtr(room), np.exp(-(room**2) / 2) / np.sqrt(2 * np.pi)
    missing = room * below + density
    square = (room**2 + 1) * below + room * density
    variance = deviation**2 * (square - missing**2)
    covariance = below[:, :, None] * law.covariance * below[:, None, :]
    index = np.arange(covariance.shape[1])
    covariance[:, index, index] = np.maximum(variance, _LEAST * deviation**2)
    return Law(law.ceiling - deviation * missing, covariance)


def information(bench: Bench, law: Law) -> float:
    """Twice the divergence of a law from the nearest one that the twin can fit.

    Of a saturated receiver only the mean and the covariance count, see `shown`.

    Args:
        bench: the sound law and the twin's freedom.
        law: the one with a fault.
    """
    law = shown(law)
    entropy = _log_determinant(law.covariance)
    difference = law.mean - bench.law.mean

    def twice(logarithms: np.ndarray) -> float:
        covariance = bench.family(logarithms)
        inverse = _inverse(covariance)
        left = _remaining(difference, bench.tangents, inverse)
        spread = np.einsum("bij,bji->", inverse, law.covariance)
        fit = np.einsum("bi,bij,bj->", left, inverse, left)
        return float(_log_determinant(covariance) - entropy + spread + fit - difference.size)

    near = [(value - _WIDEST, value + _WIDEST) for value in bench.start]
    found = optimize.minimize(twice, bench.start, method="L-BFGS-B", bounds=near)
    return max(0.0, min(float(found.fun), twice(bench.start)))


def _inverse(covariance: Covariance) -> Covariance:
    if covariance.strides[0] == 0:  # one matrix, the same in all blocks
        return np.broadcast_to(np.linalg.inv(covariance[0]), covariance.shape)
    return np.linalg.inv(covariance)


def _log_determinant(covariance: Covariance) -> float:
    """Sum over the blocks."""
    if covariance.strides[0] == 0:
        return len(covariance) * float(np.linalg.slogdet(covariance[0])[1])
    return float(np.linalg.slogdet(covariance)[1].sum())


def visible(bench: Bench, law: Law) -> Float[np.ndarray, " direction"]:
    """What a fault changes beyond what the twin can imitate, to first order, in standard deviations.

    The change of the mean, then that of the covariance; the square of its length is lambda where that is small.
    """
    law = shown(law)
    inverse = np.linalg.inv(bench.law.covariance)
    root = np.linalg.cholesky(inverse)
    left = _remaining(law.mean - bench.law.mean, bench.tangents, inverse)

    def white(covariance: Covariance) -> np.ndarray:
        change = covariance - bench.law.covariance
        return (np.einsum("bki,bkl,blj->bij", root, change, root) / np.sqrt(2)).reshape(-1)

    steps = bench.start + _STEP * np.eye(len(bench.start))
    basis = np.stack([white(bench.family(step)) for step in steps], axis=1)
    spread = white(law.covariance)
    spread = spread - basis @ np.linalg.lstsq(basis, spread, rcond=None)[0]
    return np.concatenate([np.einsum("bji,bj->bi", root, left).reshape(-1), spread])


def sized(bench: Bench, fault: Fault, target: float) -> Sized | None:
    """A fault of the size at which its information is `target`; None where no size gives that.

    Args:
        bench: the sound law and the twin's freedom.
        fault: which.
        target: lambda.

    Raises:
        InputError: the fault at its limit is not that informative.
    """
    size, found = size_for(
        target, lambda size: information(bench, fault.change(bench.law, size)), limit=fault.limit
    )
    return Sized(fault, size, found) if abs(found / target - 1) <= _TOLERANCE else None


def measure(rng: np.random.Generator, law: Law) -> Vector:
    """One draw of all measurements."""
    root = np.linalg.cholesky(law.covariance)
    drawn = law.mean + np.einsum("bij,bj->bi", root, rng.standard_normal(law.mean.shape))
    return np.minimum(drawn, law.ceiling)


def _remaining(difference: Vector, tangents: Tangents, inverse: Covariance) -> Vector:
    """A change of the mean after generalised least squares on the tangents."""
    if not tangents.shape[2]:
        return difference
    weighted = np.einsum("bij,bjk->bik", inverse, tangents)
    gram = np.einsum("bik,bil->kl", tangents, weighted)
    coefficients = np.linalg.lstsq(gram, np.einsum("bik,bi->k", weighted, difference), rcond=None)[0]
    return difference - tangents @ coefficients
