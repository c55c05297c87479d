"""How much of what several effects close together each of them closes: Shapley values, the part they share apart.

Effects that the data cannot fully tell apart close the same part of a gap, so that the order in which they are added
decides whom it is credited to; Shapley's value averages over all orders (Shapley 1953; for explained variance Lindeman,
Merenda and Gold 1980).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import factorial

import jax
import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.refit import at_null_except
from dtprob.gap.how_far.closed import HeldOut, cross_fit, resampled
from dtprob.gap.model.problem import Problem

_DRAWS = 2000


@dataclass(frozen=True)
class Share:
    """Part of what a set of effects closes, by one of them.

    Attributes:
        effect: its name.
        mean, low, high: Shapley's value over what the set closes, with its 90% interval over clusters.
        own: what the set would close less without it, over what it closes; the rest of `mean` another effect of the
            set could close too.
    """

    effect: str
    mean: float
    low: float
    high: float
    own: float


def shapley(
    effects: Sequence[str], value: Mapping[frozenset[str], Float[np.ndarray, " cluster"]]
) -> dict[str, Float[np.ndarray, " cluster"]]:
    """Shapley's value of each effect.

    Args:
        effects: their names.
        value: of every subset, the empty one included.
    """
    n, result = len(effects), {}
    for effect in effects:
        others = [other for other in effects if other != effect]
        total = np.zeros_like(value[frozenset()])
        for size in range(n):
            weight = factorial(size) * factorial(n - size - 1) / factorial(n)
            for chosen in map(frozenset, combinations(others, size)):
                total = total + weight * (value[chosen | {effect}] - value[chosen])
        result[effect] = total
    return result


def shares(
    problem: Problem,
    fitted: fitting.Fit,
    held: tuple[HeldOut, HeldOut],
    assignment: np.ndarray,
    key: jax.Array,
) -> tuple[Share, ...]:
    """The part of each effect of a fit in the held-out nats that all gain together; empty for fewer than two effects.

    Args:
        problem: in which the effects are live.
        fitted: the fit with all of them.
        held: held-out results without any and with all of them.
        assignment: the fold of each cluster.
        key: for the bootstrap over clusters.
    """
    effects = fitted.effects
    if len(effects) < 2:
        return ()
    value = {frozenset(): held[0].log_likelihood, frozenset(effects): held[1].log_likelihood}
    for size in range(1, len(effects)):
        for chosen in combinations(effects, size):
            start = at_null_except(problem, fitted, chosen)
            part = fitting.fit(problem, start, chosen, spread=fitted.spread)
            value[frozenset(chosen)] = cross_fit(problem, part, assignment).log_likelihood
    gained = value[frozenset(effects)] - value[frozenset()]
    if gained.sum() <= 0:
        return ()
    values = shapley(effects, value)
    index = resampled(len(gained), held[1].alone, key, _DRAWS)
    total = gained[index].sum(1)
    found = []
    for effect in effects:
        drawn = values[effect][index].sum(1)[total > 0] / total[total > 0]
        low, high = np.quantile(drawn, [0.05, 0.95])
        left_out = value[frozenset(effects) - {effect}]
        found.append(
            Share(
                effect,
                mean=float(values[effect].sum() / gained.sum()),
                low=float(low),
                high=float(high),
                own=float((value[frozenset(effects)] - left_out).sum() / gained.sum()),
            )
        )
    return tuple(found)
