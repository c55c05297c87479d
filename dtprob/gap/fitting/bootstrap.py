"""Data sets drawn at a fit, with which a diagnosis compares the data: drawn a portion at a time, as often as wanted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.leverage import lost
from dtprob.gap.fitting.projection import Projection
from dtprob.gap.keys import key_for
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings

_PORTION: Final = 50
"""Replicates that are held at once."""
_MOST_VALUES: Final = 2e7
"""Values of sites that further replicates may hold together."""


@dataclass(frozen=True)
class Replicates:
    """The data and data sets drawn at a fit, the nuisances refitted to first order, and what they say at the sites.

    Attributes:
        problem, fitted, projection: where they are drawn.
        key: of all draws.
        keys: one per replicate.
        raw: rows of the data (cluster, row), as if nothing had been fitted.
        rows: projected rows of the data and of the first replicates (1 + replicate, cluster, row).
        gradients: site gradients of the same, (1 + replicate, *site) by site.
        together: how many of these replicates go through a program at once; see `parts`.
    """

    problem: Problem
    fitted: Fit
    projection: Projection
    key: jax.Array
    keys: jax.Array
    raw: np.ndarray
    rows: np.ndarray
    gradients: Mapping[str, jax.Array]
    together: int

    @property
    def at_sites(self) -> int:
        """Number of replicates that are taken to the sites."""
        return len(self.rows) - 1

    def most(self, times: int) -> int:
        """How many times more replicates can be taken to the sites, at most `times`; fewer where the sites are large."""
        entries = sum(g[0].size for g in self.gradients.values())
        return int(min(_MOST_VALUES / (max(self.at_sites, 1) * max(entries, 1)), times))

    def parts(self) -> Iterator[dict[str, jax.Array]]:
        """Site gradients of the data and of some replicates at a time, (1 + `together`, *site) by site."""
        for low in range(1, len(self.rows), self.together):
            index = np.array([0, *range(low, low + self.together)])
            yield {name: gradient[index] for name, gradient in self.gradients.items()}

    def site_gradients(self, rows: np.ndarray) -> dict[str, jax.Array]:
        """Gradients (n, *site) by site of projected rows (n, cluster, row)."""
        return _site_gradients(self.problem, self.fitted, self.projection, rows)

    def of_rows(self, rows: np.ndarray) -> Replicates:
        """The same with other projected rows (1 + replicate, cluster, row), and their site gradients."""
        parts = [
            self.site_gradients(np.concatenate([rows[:1], rows[low : low + self.together]]))
            for low in range(1, len(rows), self.together)  # of the shape that is compiled
        ]
        gradients = {
            n: jnp.asarray(
                np.concatenate([np.asarray(parts[0][n])[:1], *(np.asarray(part[n])[1:] for part in parts)])
            )
            for n in self.gradients
        }
        return replace(self, rows=rows, gradients=gradients)

    def portions(self) -> Iterator[tuple[np.ndarray, Mapping[str, jax.Array]]]:
        """All replicates: whitened rows (replicate, cluster, row), not projected, and observed values by site."""
        return _portions(self.problem, self.fitted, self.projection, self.keys)


def replicate(
    problem: Problem, fitted: Fit, projection: Projection, key: jax.Array, settings: Settings
) -> Replicates:
    """The bootstrap that the screening and the maps share.

    Args:
        problem: the model on its data.
        fitted: where to draw.
        projection: at the fit.
        key: of the draws.
        settings: how many replicates there are, and how many of them are taken to the sites.
    """
    keys = jax.random.split(key_for(key, "replicates"), settings.replicates)
    raw, observed = observed_rows(problem, fitted, projection)
    projected = _projected(problem, fitted, projection, keys[: settings.site_replicates])
    rows = np.concatenate([observed[None], projected])
    gradients = _site_gradients(problem, fitted, projection, rows)
    return Replicates(
        problem, fitted, projection, key, keys, raw, rows, gradients, together=max(len(projected), 1)
    )


def observed_rows(problem: Problem, fitted: Fit, projection: Projection) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the data (cluster, row) as if nothing had been fitted, and projected."""
    residual = np.asarray(problem.compiled.residual(fitted.x)) + lost(problem, fitted, projection)
    raw = projection.before_fit(residual)
    return raw, projection.rows(raw[None])[0]


def _site_gradients(
    problem: Problem, fitted: Fit, projection: Projection, rows: np.ndarray
) -> dict[str, jax.Array]:
    """Gradients (n, *site) by site of rows (n, cluster, row)."""
    gradient, centre = problem.compiled.site_gradient, projection.centre
    if centre is None:
        return gradient(fitted.x, rows)
    here, there = centre.split(rows)
    return jax.tree.map(jnp.add, gradient(fitted.x, here), gradient(centre.x, there))


def more(drawn: Replicates, times: int) -> Replicates:
    """As many times more replicates at the sites, all of them new.

    Args:
        drawn: a first look at the same fit.
        times: how many more; see `Replicates.most`.
    """
    first = drawn.at_sites
    keys = jax.random.split(key_for(drawn.key, f"{times} more"), times * first)
    projected = _projected(drawn.problem, drawn.fitted, drawn.projection, keys)
    return replace(drawn, together=first).of_rows(np.concatenate([drawn.rows[:1], projected]))


def normal_like(drawn: Replicates) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Normal projected rows (replicate, cluster, row) of the replicates' covariance, as many as these, and site gradients.

    Rare outcomes may be seen by no replicate; in these they have their share. What does not count has none.
    """
    of_noise, of_prior = jax.random.split(key_for(drawn.key, "normal"))
    keys = jax.random.split(of_prior, drawn.at_sites)
    counts = drawn.problem.rows.of_entries(drawn.problem.observed.counted) > 0
    rows = counts * np.asarray(jax.random.normal(of_noise, (drawn.at_sites, *drawn.raw.shape)))
    projected = drawn.projection.rows(drawn.projection.with_prior(rows, keys))
    found = drawn.site_gradients(np.concatenate([drawn.rows[:1], projected]))
    return projected, {name: np.asarray(g)[1:] for name, g in found.items()}


def _projected(problem: Problem, fitted: Fit, projection: Projection, keys: jax.Array) -> np.ndarray:
    parts = _portions(problem, fitted, projection, keys)
    return np.concatenate([projection.rows(rows) for rows, _ in parts])


def _portions(
    problem: Problem, fitted: Fit, projection: Projection, keys: jax.Array
) -> Iterator[tuple[np.ndarray, Mapping[str, jax.Array]]]:
    """Portions of one size are drawn, so that one program serves all; of the last one as much as there are keys.

    Noise and the prior's draws have keys of their own: one that was split for the one and folded for the other would give
    both the same numbers.
    """
    place = np.arange(-(-len(keys) // _PORTION) * _PORTION).reshape(-1, _PORTION)
    for part in place:
        of_noise, of_prior = jax.vmap(jax.random.split, out_axes=1)(keys[np.minimum(part, len(keys) - 1)])
        rows, values = problem.compiled.replicate(fitted.x, of_noise)
        count = int((part < len(keys)).sum())
        yield (
            projection.with_prior(np.asarray(rows), of_prior)[:count],
            {n: v[:count] for n, v in values.items()},
        )
