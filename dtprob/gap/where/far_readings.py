"""Readings that lie far out, anywhere: which they are, and what places tell where these count for no more than others.

A place is as wrong as its farthest reading makes it: one of 540 readings at seven standard deviations makes its day's
spread surely wrong, and says nothing of the day. Rows held where few of a right twin's lie (Huber, Ann. Math. Stat. 35
(1964) 73) still tell of a place where many are off.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from dtprob.gap.fitting.bootstrap import Replicates
from dtprob.gap.observation.likelihoods import likelihood
from dtprob.gap.where.site_finding import SiteFinding

_BEYOND: Final = 0.005
"""Share of a right twin's rows that are held, on each side."""
_BY_CHANCE: Final = 0.5
"""Readings of a right twin that lie as far out as one that is named, at most."""
_NAMED: Final = 8
"""Readings that are named, at most."""


def far_readings(drawn: Replicates, found: Iterable[SiteFinding]) -> dict[str, str]:
    """Observations with normal rows of which surely too many readings lie far out, or to one side; and in words which.

    Args:
        drawn: the data and replicates.
        found: findings of further moments.
    """
    families = drawn.problem.families
    normal = {f.site for f in found if f.strays and likelihood(families[f.site]).log_scale is not None}
    told = {name: _farthest(drawn, name) for name in normal}
    return {name: words for name, words in told.items() if words is not None}


def held(drawn: Replicates, names: Collection[str]) -> Replicates:
    """The data and replicates with rows of some observations held.

    Holding moves a mean and a spread of all, which a refit to first order takes back: what it changes is projected.

    Args:
        drawn: the data and replicates.
        names: the observations.
    """
    problem, every = drawn.problem, drawn.problem.rows.by_site(drawn.rows)
    for name in names:
        own = every[name]
        ends = np.quantile(own[1:][..., problem.observed.counted[name]], (_BEYOND, 1 - _BEYOND), axis=(0, 2))
        low, high = (end.reshape(-1, *(1,) * (own.ndim - 2)) for end in ends)
        every[name] = np.clip(own, low, high)
    rows = np.asarray(jax.vmap(problem.rows.stack)({n: jnp.asarray(row) for n, row in every.items()}))
    return drawn.of_rows(drawn.rows + drawn.projection.rows(rows - drawn.rows))


def naming(found: Iterable[SiteFinding], which: Mapping[str, str]) -> list[SiteFinding]:
    """Findings of further moments; those of far readings, which were held at sites, say which of them these are."""
    return [
        replace(f, place=which[f.site], is_held=True) if f.is_of_far and f.site in which else f for f in found
    ]


def _farthest(drawn: Replicates, name: str) -> str | None:
    """In words, the readings of an observation that lie farther out than a right twin has any; None where none does."""
    problem, site = drawn.problem, drawn.problem.declaration.observed[name]
    rows = problem.rows.by_site(drawn.rows)[name]
    located = 2 if likelihood(problem.families[name]).is_complex else 1
    counted = problem.observed.counted[name]
    variance = (rows[1:, :located][..., counted] ** 2).mean()
    away = np.where(counted, (rows[0, :located] ** 2).sum(axis=0) / variance, 0.0)
    far = np.flatnonzero(counted.sum() * stats.chi2.sf(away, located) < _BY_CHANCE)
    if not len(far):
        return None
    far = far[np.argsort(-away.reshape(-1)[far])]
    axes = [i for i, n in enumerate(counted.shape) if n > 1]
    places = [np.unravel_index(one, counted.shape) for one in far[:_NAMED]]
    words = [", ".join(f"{site.axes[i]} {place[i]}" for i in axes) for place in places]
    if len(axes) == 1:  # the axis is named once
        words[1:] = [str(place[axes[0]]) for place in places[1:]]
    farthest = ", the farthest" if len(far) > _NAMED else ""
    several = f"{len(far)} readings that lie far out{farthest}" if len(far) > 1 else "one reading"
    return f"{several}: {(', ' if len(axes) == 1 else '; ').join(words)}"
