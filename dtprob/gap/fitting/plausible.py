"""How much an effect explains, weighed against how many sizes it could have had.

An effect's prior says which sizes are plausible at most; real ones may be far smaller. Its scale is therefore mixed,
log-uniformly, so that the price of an effect depends on how well the data determine it and not on its units.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike
from scipy import special

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.bounded import log_positive

SCALES: Final = np.geomspace(1e-4, 1.0, 25)
"""Prior scales, as shares of the largest plausible one."""
WHOLE: Final = 10 / 7
"""Size at which a share is whole, in standard deviations of its prior, which is 0.7 wide."""
LARGE: Final = np.array([-2.0, -WHOLE, -0.7, 0.7, WHOLE, 2.0])
"""Large sizes to try, in standard deviations of the prior."""


def log_bayes_factor(
    information: Float[np.ndarray, "n n"],
    score: Float[np.ndarray, " n"],
    scale: Float[np.ndarray, " n"],
    *,
    one_sided: bool = False,
) -> float:
    """Log Bayes factor of a normal likelihood against the null, the scale of the prior mixed.

    For prior covariance (s T)^2 it is -1/2 log|I + s^2 T J T| + 1/2 s^2 u' T (I + s^2 T J T)^-1 T u.

    Args:
        information: J, nuisance-adjusted.
        score: u, likewise.
        scale: T, the prior's standard deviations.
        one_sided: of a single parameter that cannot be below its null.
    """
    return float(
        special.logsumexp(_terms(information, score, scale, SCALES, one_sided)) - np.log(len(SCALES))
    )


def mixing_gain(
    covariance: Float[np.ndarray, "n n"],
    estimate: Float[np.ndarray, " n"],
    scale: Float[np.ndarray, " n"],
    *,
    sides: Bool[np.ndarray, " n"] | None = None,
    places: Bool[np.ndarray, " n"] | None = None,
) -> float:
    """What mixing the prior's scale adds to a log evidence that was computed at its largest.

    That evidence is Laplace's, over all sizes, and with the density of the prior at the mode; of sizes that cannot be below
    their null only those above it count.

    Args:
        covariance: of the parameters given the data, under the prior at its largest scale.
        estimate: the posterior mode less the null, of the quadratic: where data push a size against its null, below it.
        scale: the prior's standard deviations.
        sides: sizes that cannot be below their null; none by default.
        places: parameters whose prior is not mixed; none by default.
    """
    n = len(scale)
    sides, places = (np.zeros(n, bool) if v is None else v for v in (sides, places))
    precision = np.linalg.inv(covariance / np.outer(scale, scale))
    information, score = precision - np.eye(n), precision @ (estimate / scale)
    shares = np.array([*SCALES, 1.0])
    share = np.where(places, 1.0, shares[:, None])
    spread = np.eye(n) + share[:, :, None] * information * share[:, None, :]
    mean = np.linalg.solve(spread, (share * score)[..., None])[..., 0]
    terms = 0.5 * (np.einsum("si,si->s", share * score, mean) - np.linalg.slogdet(spread)[1])
    last, sided = terms[-1], sides & ~places
    if sided.any():
        among = np.linalg.inv(spread)[:, sided][:, :, sided]
        terms = terms + log_positive(mean[:, sided], among)
    return float(special.logsumexp(terms[:-1]) - np.log(len(SCALES)) - last)


def _terms(
    information: np.ndarray, score: np.ndarray, scale: np.ndarray, scales: np.ndarray, one_sided: bool
) -> np.ndarray:
    """The log Bayes factor at each of the prior's scales."""
    j, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    j, u = np.maximum(j, 0.0), vectors.T @ (score * scale)
    spread = 1 + scales[:, None] ** 2 * j
    terms = 0.5 * (scales[:, None] ** 2 * u**2 / spread - np.log(spread)).sum(axis=1)
    if one_sided and len(u) == 1:
        above = (score * scale)[0] * scales / np.sqrt(spread[:, 0])
        terms = terms + np.log(2.0) + special.log_ndtr(above)
    return terms


def scales(effect: Effect) -> Float[np.ndarray, " n"]:
    """Prior standard deviation of each of an effect's parameters, flat."""
    return _flat(effect, [p.scale for p in effect.parameters])


def nulls(effect: Effect) -> Float[np.ndarray, " n"]:
    """The null of each of an effect's parameters, flat."""
    return _flat(effect, [p.null for p in effect.parameters])


def sides(effect: Effect) -> Bool[np.ndarray, " n"]:
    """Which of an effect's parameters cannot be below their null, flat."""
    return _flat(effect, [p.is_one_sided for p in effect.parameters])


def limits(effect: Effect) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The lowest and the highest value that its prior allows each of an effect's parameters, flat."""
    ends = [p.limits for p in effect.parameters]
    return _flat(effect, [low for low, _ in ends]), _flat(effect, [high for _, high in ends])


def places(effect: Effect) -> Bool[np.ndarray, " n"]:
    """Which of an effect's parameters say where it acts, flat."""
    return _flat(effect, [p.is_place for p in effect.parameters])


def sizes(effect: Effect) -> Int[np.ndarray, " size"]:
    """Positions, among an effect's flat parameters, of those that are no places."""
    return np.flatnonzero(~places(effect))


def plausible_spread(effect: Effect) -> float:
    """The largest plausible standard deviation of a random field's entries, in the unit of the effect."""
    return float(scales(effect)[sizes(effect)].max())


def is_one_sided(effect: Effect) -> bool:
    """Whether an effect has a single size, which cannot be below its null, and else only places."""
    index = sizes(effect)
    return len(index) == 1 and bool(sides(effect)[index[0]])


def _flat(effect: Effect, values: Sequence[ArrayLike]) -> np.ndarray:
    parts = [np.broadcast_to(v, p.shape).reshape(-1) for v, p in zip(values, effect.parameters, strict=True)]
    return np.concatenate(parts)
