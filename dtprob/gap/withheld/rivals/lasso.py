"""The LASSO on residual features: all candidates' tangents at once, few of them with a coefficient.

Source: Tibshirani, J. R. Stat. Soc. B 58 (1996) 267; the whole path by Efron, Hastie, Johnstone & Tibshirani, Ann. Stat. 32
(2004) 407. The penalty is chosen by the extended BIC (Chen & Chen, Biometrika 95 (2008) 759) of least squares on what it
leaves (Meinshausen, Comput. Stat. Data Anal. 52 (2007) 374): with shrunken coefficients far too many are kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import special

from dtprob.gap.fitting.plausible import is_one_sided
from dtprob.gap.withheld.rivals.claim import Claim
from dtprob.gap.withheld.rivals.look import Look, chance

_LONGEST = 40
"""Knots of the path that are looked at."""
_HIDDEN = 1e-6
"""Share of a feature's norm that must be left after the nuisances for it to be one."""
_ROUNDING = 1e-10


class Features(NamedTuple):
    """Residual features of unit norm.

    Attributes:
        score: inner products with the residual, (1 + replicate, feature), the data first.
        correlation: of the features.
        positive: which may only have positive coefficients.
        owner: index of each feature's effect.
    """

    score: Float[np.ndarray, "n feature"]
    correlation: Float[np.ndarray, "feature feature"]
    positive: Bool[np.ndarray, " feature"]
    owner: np.ndarray


def lasso(seen: Look) -> Claim:
    """Name the effects with a coefficient where the extended BIC ends the path; rank by coefficients.

    The alarm is the penalty at which the path begins: the largest score of all features.

    Args:
        seen: the base fit.
    """
    features = _features(seen)
    if not len(features.owner):
        return Claim(1.0, (), seen.names)
    largest = np.where(features.positive, features.score, np.abs(features.score)).max(axis=1)
    score, n = features.score[0], seen.problem.observed.count
    knots = list(path(score, features.correlation, features.positive))
    best = min(knots, key=lambda b: extended_bic(b != 0, score, features.correlation, n))
    weight = np.zeros(len(seen.effects))
    np.maximum.at(weight, features.owner, np.abs(best))
    order = np.lexsort((-seen.gain[0], -weight))
    ranking = tuple(seen.names[i] for i in order)
    return Claim(chance(largest), ranking[: int((weight > 0).sum())], ranking)


def path(
    score: Float[np.ndarray, " n"], correlation: Float[np.ndarray, "n n"], positive: Bool[np.ndarray, " n"]
) -> Iterator[Float[np.ndarray, " n"]]:
    """The coefficients at the knots of the path of min 1/2 b'Rb - u'b + penalty |b|_1, from none on.

    Args:
        score: u, inner products of the features with the response.
        correlation: R, inner products of the features with one another.
        positive: which coefficients may not be negative.
    """
    b, active = np.zeros(len(score)), list[int]()
    penalty = float(np.where(positive, score, np.abs(score)).max(initial=0.0))
    yield b
    if penalty <= 0:
        return
    entered = True
    for _ in range(_LONGEST):
        c = score - correlation @ b
        if entered:
            joins = np.where(positive, c, np.abs(c))
            joins[active] = -np.inf
            active.append(int(np.argmax(joins)))
        part = correlation[np.ix_(active, active)]
        direction = np.linalg.lstsq(part, np.sign(c[active]), rcond=None)[0]
        change = correlation[:, active] @ direction
        step, leaves = _next(
            c, change, b[active], direction, penalty=penalty, active=active, positive=positive
        )
        b = b.copy()
        b[active] += step * direction
        penalty -= step
        entered = leaves is None
        if leaves is not None:
            b[active.pop(leaves)] = 0.0
        yield b
        if penalty <= _ROUNDING * abs(score).max() or len(active) == len(score) or not active:
            return


def _next(
    c: np.ndarray,
    change: np.ndarray,
    b: np.ndarray,
    direction: np.ndarray,
    *,
    penalty: float,
    active: list[int],
    positive: np.ndarray,
) -> tuple[float, int | None]:
    """How far the path goes straight on, and which coefficient then becomes zero, if it is not that another joins."""
    idle = np.ones(len(c), bool)
    idle[active] = False
    with np.errstate(divide="ignore", invalid="ignore"):
        up, down = (penalty - c) / (1 - change), (penalty + c) / (1 + change)
        zero = -b / direction
    tiny = _ROUNDING * penalty
    up = np.where(idle & (up > tiny), up, np.inf)
    down = np.where(idle & ~positive & (down > tiny), down, np.inf)
    zero = np.where((zero > tiny) & (b != 0), zero, np.inf)
    join = min(float(up.min()), float(down.min()), penalty)
    first = int(np.argmin(zero))
    return (float(zero[first]), first) if zero[first] < join else (join, None)


def extended_bic(
    kept: Bool[np.ndarray, " n"],
    score: Float[np.ndarray, " n"],
    correlation: Float[np.ndarray, "n n"],
    observations: int,
) -> float:
    """Of least squares on some features, noise of unit variance; a constant is left out.

    Args:
        kept: the features.
        score: inner products of all features with the response.
        correlation: of all features.
        observations: number of them.
    """
    size, total, own = int(kept.sum()), len(kept), score[kept]
    fitted = np.linalg.lstsq(correlation[np.ix_(kept, kept)], own, rcond=None)[0]
    sets = special.gammaln(total + 1) - special.gammaln(size + 1) - special.gammaln(total - size + 1)
    return float(-own @ fitted + size * np.log(observations) + 2 * sets)


def _features(seen: Look) -> Features:
    """Of the effects' parameters, those that the fit does not hide; a random field has no feature."""
    own = np.diag(seen.scores.information)
    kept = np.flatnonzero(own > _HIDDEN * np.maximum(seen.scores.total, 1e-300))
    root = np.sqrt(own[kept])
    owner = np.concatenate(
        [np.zeros(0, int), *(np.full(len(g), k) for k, g in enumerate(seen.scores.groups))]
    )
    sided = np.array([is_one_sided(e) for e in seen.scores.effects], bool)
    return Features(
        score=seen.u[:, kept] / root,
        correlation=seen.scores.information[np.ix_(kept, kept)] / np.outer(root, root),
        positive=sided[owner[kept]],
        owner=owner[kept],
    )
