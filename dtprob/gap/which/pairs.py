"""Pairs of effects that explain more together than the effects that a search would take one after another."""

from __future__ import annotations

import itertools
from typing import Final, NamedTuple

import numpy as np

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.plausible import log_bayes_factor, scales, sides

_MOST: Final = 80
"""Effects, the best alone, of which pairs are formed."""
_KEPT: Final = 3


class Pair(NamedTuple):
    """Two effects and their log Bayes factor together, to first order."""

    names: tuple[str, str]
    log_bayes_factor: float


def best_pairs(
    effects: tuple[Effect, ...],
    groups: tuple[np.ndarray, ...],
    information: np.ndarray,
    score: np.ndarray,
    alone: np.ndarray,
    *,
    price: np.ndarray,
) -> tuple[Pair, ...]:
    """The best pairs by Bayesian subset search on scores and their information; none that data push below a null.

    Args:
        effects: mean effects.
        groups: the coordinates (n,) of each effect's parameters.
        information: J (coordinate, coordinate), nuisances adjusted for.
        score: u (coordinate,), likewise.
        alone: log Bayes factor of each effect alone.
        price: what each costs besides, in nats.
    """
    chosen = sorted(np.argsort(-alone)[:_MOST].tolist())
    found: list[Pair] = []
    for i, j in itertools.combinations(chosen, 2):
        both = np.concatenate([groups[i], groups[j]])
        scale = np.concatenate([scales(effects[i]), scales(effects[j])])
        sided = np.concatenate([sides(effects[i]), sides(effects[j])])
        own = information[np.ix_(both, both)]
        if sided.any() and (np.linalg.solve(own + np.diag(scale**-2.0), score[both])[sided] < 0).any():
            continue
        value = log_bayes_factor(own, score[both], scale) - price[[i, j]].sum()
        found.append(Pair((effects[i].name, effects[j].name), value))
    return tuple(sorted(found, key=lambda pair: -pair.log_bayes_factor)[:_KEPT])
