"""Detection of a disconnected device from windows of one cluster's arrivals, with every window weighed exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final, final

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy import special

from dtprob.inference.exact import DirichletTables
from dtprob.models.dirichlet import log_shares
from dtprob.twin import statistics
from dtprob.twin.likelihood import table_likelihoods

NORMAL: Final = np.array([0.2, 0.4, 0.4, 0.0])
"""Joint arrivals of a cluster: of none, the second, the first, both devices."""
CHANGED: Final = np.array([0.6, 0.0, 0.4, 0.0])
"""The same with the second device disconnected."""
PRIOR: Final = 0.01
MODE: Final = 1.01
JEFFREYS: Final = 0.5
DRAWS: Final = 1000
METHODS: Final = ("bayesian", "map", "evidence", "evidence_disconnected")
_SITE: Final = "log_arrival"


@final
@dataclass(frozen=True)
class Windows:
    """All windows of independent slots, up to the order of their slots.

    Attributes:
        length: slots of a window.
    """

    length: int

    @cached_property
    def counts(self) -> Float[np.ndarray, "window outcome"]:
        """How often each joint arrival occurs in each window."""
        first, second = np.indices((self.length + 1, self.length + 1)).reshape(2, -1)
        kept = first + second <= self.length
        none = self.length - first[kept] - second[kept]
        return np.stack([none, second[kept], first[kept], np.zeros_like(none)], axis=1).astype(float)

    def probability(self, law: Float[np.ndarray, " outcome"]) -> Float[np.ndarray, " window"]:
        """Of each window when slots follow a law."""
        orders = special.gammaln(self.length + 1) - special.gammaln(self.counts + 1).sum(axis=1)
        return np.exp(orders + special.xlogy(self.counts, law).sum(axis=1))


def learn(
    key: PRNGKeyArray, slots: int, models: int
) -> tuple[Float[np.ndarray, "model outcome"], Float[np.ndarray, "draw model outcome"]]:
    """Counts of as many normal slots, and posterior draws of the log-probabilities, of each model."""
    seed = int(jax.random.randint(key, (), 0, 2**31 - 1))
    counts = np.random.default_rng(seed).multinomial(slots, NORMAL, size=models).astype(float)
    prior = DirichletTables({_SITE: np.full(counts.shape, PRIOR)})
    return counts, prior.updated({_SITE: counts}).sample(jax.random.fold_in(key, 1), DRAWS)[_SITE]


def judge(
    counts: Float[np.ndarray, " outcome"],
    draws: Float[np.ndarray, "draw outcome"],
    fresh: Float[np.ndarray, "draw outcome"],
    windows: Windows,
) -> Mapping[str, Float[np.ndarray, " window"]]:
    """The statistic of each window by each method, large after a change.

    Args:
        counts: what one model was learned from.
        draws: of its posterior.
        fresh: of the prior of changed parameters.
        windows: to judge.
    """

    def likelihood(tables: Float[np.ndarray, "draw outcome"]) -> Float[np.ndarray, "draw window"]:
        return table_likelihoods({_SITE: windows.counts}, {_SITE: tables})[_SITE]

    normal = likelihood(draws)
    point = log_shares(counts + MODE - 1, np.ones(counts.shape, dtype=bool))[None]
    return {
        "bayesian": statistics.disagreement(normal),
        "map": statistics.surprise(likelihood(point)),
        "evidence": statistics.log_evidence(likelihood(fresh), normal),
        "evidence_disconnected": statistics.log_evidence(likelihood(disconnected(draws)), normal),
    }


def fresh_draws(key: PRNGKeyArray) -> Float[np.ndarray, "draw outcome"]:
    """Draws of Jeffreys' prior of the log-probabilities, what an unknown change may bring."""
    return DirichletTables({_SITE: np.full(4, JEFFREYS)}).sample(key, DRAWS)[_SITE]


def disconnected(draws: Float[np.ndarray, "draw outcome"]) -> Float[np.ndarray, "two_draws outcome"]:
    """The draws with the first, then with the second device silent."""
    never = np.full(len(draws), -np.inf)
    none, second, first, both = draws.T
    without_first = [np.logaddexp(none, first), np.logaddexp(second, both), never, never]
    without_second = [np.logaddexp(none, second), never, np.logaddexp(first, both), never]
    return np.concatenate([np.stack(without_first, axis=1), np.stack(without_second, axis=1)])
