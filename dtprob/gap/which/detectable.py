"""From which size on an effect would be noticed."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import optimize, stats

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting.plausible import is_one_sided, scales, sizes

_NOTICED: Final = 0.9
"""Probability with which it would be."""


class Detectable(NamedTuple):
    """A size that would be noticed nine times in ten, None where none would be, and the parameter that it is of."""

    size: float | None
    parameter: Parameter


def detectable(
    effect: Effect, information: Float[np.ndarray, " entry"], directions: int, level: float
) -> Detectable:
    """The size, of the entry that shows most clearly at its usual size, from which on an effect is noticed.

    Scores of several directions are noticed by their sum of squares, chi-square with as many degrees and of noncentrality
    size^2 J; a single one by its normal quantile, on the side that its prior allows or on either.

    Args:
        effect: which.
        information: J of its flat entries, nuisance-adjusted.
        directions: how many directions its scores have.
        level: false-alarm probability of its test.
    """
    index = sizes(effect)
    own = information[index]
    best = int(np.argmax(own * scales(effect)[index] ** 2))
    if not own[best] > 0:
        return Detectable(None, _owner(effect, int(index[best])))
    needed = _needed(directions, level if is_one_sided(effect) else level / 2, level)
    return Detectable(float(np.sqrt(needed / own[best])), _owner(effect, int(index[best])))


def _needed(directions: int, tail: float, level: float) -> float:
    """Noncentrality that is noticed, of a single direction beyond the quantile of a tail."""
    if directions < 2:
        return float(stats.norm.isf(tail) + stats.norm.isf(1 - _NOTICED)) ** 2
    threshold = float(stats.chi2.isf(level, directions))
    bracket = (0.0, 4 * threshold + 100.0)
    found = optimize.root_scalar(
        lambda x: stats.ncx2.sf(threshold, directions, x) - _NOTICED, bracket=bracket
    )
    return float(found.root)


def _owner(effect: Effect, position: int) -> Parameter:
    """The parameter that one of the flat entries belongs to."""
    ends = np.cumsum([p.size for p in effect.parameters])
    return effect.parameters[int(np.searchsorted(ends, position, side="right"))]
