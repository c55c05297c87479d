"""What the runs of figures 9 and 10 say of tuned CPPI, in sentences: what it gains, and where it is not the best."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy import stats

from dtprob.models.prediction_powered.schemes import SCHEMES

LEVEL: Final = 0.9
_TUNED: Final = "tuned_cppi"


def gain(
    rate: Float[np.ndarray, "run scheme point"], points: Sequence[float], at: float, other: str = "erm"
) -> str:
    """The mean over runs of the rate with tuned CPPI minus that with another scheme, at one point.

    Args:
        rate: bit/s/Hz; the runs of one number share positions and folds.
        points: what is on the axis.
        at: one of them.
        other: the scheme to compare with.
    """
    names, index = list(SCHEMES), points.index(at)
    difference = rate[:, names.index(_TUNED), index] - rate[:, names.index(other), index]
    return f"mean gain over {other} at {at:g}: {_interval(difference)}"


def standing(rate: Float[np.ndarray, "run scheme point"], points: Sequence[float]) -> str:
    """At how many points tuned CPPI has the highest median, and how far below it is at worst, band and all.

    Args:
        rate: bit/s/Hz.
        points: what is on the axis.
    """
    names = list(SCHEMES)
    tuned = names.index(_TUNED)
    low, median, high = np.quantile(rate, [0.25, 0.5, 0.75], axis=0)
    others = np.delete(median, tuned, axis=0)
    short = others.max(axis=0) - median[tuned]
    best, inside = int(np.sum(short <= 0)), int(np.sum(others.max(axis=0) <= high[tuned]))
    text = f"median of {_TUNED} the highest at {best} of {len(points)} points"
    if best == len(points):
        return text
    worst = int(np.argmax(short))
    rival = [name for name in names if name != _TUNED][int(others[:, worst].argmax())]
    difference = rate[:, tuned, worst] - rate[:, names.index(rival), worst]
    return (
        f"{text}, the best other at or below its upper quartile at {inside}; "
        f"worst at {points[worst]:g}: {short[worst]:.3f} bit/s/Hz below {rival}, with quartiles "
        f"{low[tuned, worst]:.3f} and {high[tuned, worst]:.3f} around {median[tuned, worst]:.3f}, "
        f"mean difference {_interval(difference)}"
    )


def _interval(difference: Float[np.ndarray, " run"]) -> str:
    """A mean over runs with its interval by Student's t."""
    mean = f"{difference.mean():.3f} bit/s/Hz"
    if len(difference) < 2:
        return mean
    error = difference.std(ddof=1) / np.sqrt(len(difference))
    half = stats.t.ppf((1 + LEVEL) / 2, len(difference) - 1) * error
    low, high = difference.mean() - half, difference.mean() + half
    return f"{mean}, {LEVEL:.0%} interval {low:.3f} to {high:.3f}"
