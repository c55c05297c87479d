"""Scores of candidates that move what is expected, adjusted for nuisances, and their tests.

Source: Neyman's C(alpha) score, u = sum_i (s_i - B r_i) with variance J = I_ee - B I_te (Bera & Yoon 1993).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np
from scipy import stats

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.bootstrap import Replicates
from dtprob.gap.fitting.plausible import is_one_sided, log_bayes_factor, scales, sizes
from dtprob.gap.fitting.projection import Projection
from dtprob.gap.model.problem import Problem
from dtprob.gap.tails import LOG_SMALLEST, log_gamma_tail, normal_quantile
from dtprob.gap.which.directions import Tangents
from dtprob.gap.which.pairs import Pair, best_pairs

NOTHING = 1e-9
"""Share of its information that a direction keeps beside nuisances from which on the data tell of it."""


@dataclass(frozen=True)
class Scores:
    """Adjusted scores of mean effects: u of the data and of the replicates, information, and what was projected away.

    `price` is what the best of many places costs each effect, in nats; `locating` are the effects most of whose
    information is in the location of observations, not in their spread.
    """

    effects: tuple[Effect, ...]
    groups: tuple[np.ndarray, ...]
    u: np.ndarray
    u_null: np.ndarray
    information: np.ndarray
    total: np.ndarray
    coefficients: np.ndarray
    price: np.ndarray
    locating: frozenset[str]

    def part(self, k: int) -> np.ndarray:
        """Information of one effect's own parameters."""
        return self.information[np.ix_(self.groups[k], self.groups[k])]

    def root(self, k: int) -> np.ndarray:
        """Columns that whiten one effect's scores, one per direction that the data can see."""
        size = np.sqrt(np.maximum(self.total[self.groups[k]], 1e-300))
        values, vectors = np.linalg.eigh(self.part(k) / np.outer(size, size))
        keep = values > NOTHING
        return vectors[:, keep] / np.sqrt(values[keep]) / size[:, None]

    def step(self, k: int) -> np.ndarray:
        """One-step estimate of one effect's parameters."""
        return np.linalg.solve(
            self.part(k) + np.diag(scales(self.effects[k]) ** -2.0), self.u[self.groups[k]]
        )

    def asked(self, k: int) -> float:
        """Standard deviations of its prior to the size, of an effect that has one, that the data alone ask for."""
        own = self.groups[k][sizes(self.effects[k])][0]
        size = float(self.u[own]) / max(float(self.information[own, own]), 1e-300)
        return abs(size) / float(scales(self.effects[k])[sizes(self.effects[k])][0])

    @cached_property
    def log_bayes_factor(self) -> np.ndarray:
        """Of each effect, the scale of its prior mixed, see `dtprob.gap.fitting.plausible`, its place paid for."""
        pairs = zip(self.effects, self.groups, strict=True)
        return np.array([self._evidence(effect, group) for effect, group in pairs]) - self.price

    def _evidence(self, effect: Effect, group: np.ndarray) -> float:
        """Places tell nothing beside the null."""
        index = sizes(effect)
        own = group[index]
        information, scale = self.information[np.ix_(own, own)], scales(effect)[index]
        return log_bayes_factor(information, self.u[own], scale, one_sided=is_one_sided(effect))

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """The pairs that explain most together; costly, so made when first asked for."""
        return best_pairs(
            self.effects, self.groups, self.information, self.u, self.log_bayes_factor, price=self.price
        )


def mean_scores(problem: Problem, projection: Projection, drawn: Replicates, found: Tangents) -> Scores:
    """Scores of mean effects, of the data and of the replicates.

    Args:
        problem: the model on its data.
        projection: at the fit.
        drawn: the data and replicates at the fit.
        found: the effects' tangents there.
    """
    information, coefficients = projection.information(found.columns)
    total = np.einsum("cmi,cmi->i", found.columns, found.columns)
    located = np.maximum(problem.rows.by_cluster(problem.rows.located), 0.0)
    of_location = np.einsum("cmi,cmi,cm->i", found.columns, found.columns, located)
    u = _products(projection.adjoint(drawn.raw), found)
    values = problem.observed.values
    for effect, group in zip(found.effects, found.groups, strict=True):
        for extra in found.extra[effect.name]:
            own = extra.shift.T @ extra.shift
            information[np.ix_(group, group)] += own
            total[group] += np.diag(own)
            u[group] += extra.score(values[extra.site][None])[0]
    u_null = np.concatenate([_replicate_scores(projection, found, *portion) for portion in drawn.portions()])
    information = (information + information.T) / 2
    pairs = zip(found.effects, found.groups, strict=True)
    locating = frozenset(e.name for e, g in pairs if (2 * of_location[g] > total[g]).any())
    free, coefficients = np.zeros(len(found.effects)), np.asarray(coefficients)
    return Scores(
        found.effects, found.groups, u, u_null, information, total, coefficients, free, locating=locating
    )


def _replicate_scores(
    projection: Projection, found: Tangents, rows: np.ndarray, values: Mapping[str, jax.Array]
) -> np.ndarray:
    """Scores (replicate, column) of mean effects."""
    u = _products(projection.adjoint(rows), found)
    for effect, group in zip(found.effects, found.groups, strict=True):
        for extra in found.extra[effect.name]:
            u[:, group] += extra.score(values[extra.site])
    return u


def _products(rows: np.ndarray, found: Tangents) -> np.ndarray:
    """Products (..., column) of rows (..., cluster, row) with the columns of mean effects."""
    clusters, entries, count = found.columns.shape
    flat = rows.reshape(*rows.shape[:-2], clusters * entries)
    return flat @ found.columns.reshape(clusters * entries, count)


def mean_tests(scores: Scores, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """p-values and z of score vectors u (n, columns) for each effect, (n, effect)."""
    p, z = np.ones((len(u), len(scores.effects))), np.zeros((len(u), len(scores.effects)))
    for k, (effect, group) in enumerate(zip(scores.effects, scores.groups, strict=True)):
        root = scores.root(k)
        if not root.shape[1]:
            continue
        t = u[:, group] @ root
        index = sizes(effect)
        if len(index) == 1:
            z[:, k] = t[:, 0] * np.sign(root[index[0], 0])
            p[:, k] = stats.norm.sf(z[:, k]) if is_one_sided(effect) else 2 * stats.norm.sf(np.abs(z[:, k]))
        else:
            square, d = (t**2).sum(1), root.shape[1]
            log_p = log_gamma_tail(square / 2, d / 2)
            p[:, k], z[:, k] = np.exp(np.maximum(log_p, LOG_SMALLEST)), normal_quantile(log_p)
    return np.maximum(p, 1e-300), z
