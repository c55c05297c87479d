"""Readings that are in the data twice, as those of a log that was read twice: they are no two readings."""

from __future__ import annotations

from typing import Final

import numpy as np

from dtprob.gap.model.problem import Problem
from dtprob.gap.observation.likelihoods import is_continuous
from dtprob.gap.vocabulary import READ_TWICE
from dtprob.gap.where.data_columns import all_columns
from dtprob.models.declaration import Site

_FEWEST: Final = 5
"""Readings that are there again, and different values of theirs, from which on it is said."""
_ALL: Final = 0.99
"""Share of the readings under the same circumstances that are alike where a log was read twice; others differ by noise."""
_MOST: Final = 1 << 18
"""Entries of an observation up to which it is looked at."""


def read_twice(problem: Problem) -> list[str]:
    """A note for each observation that holds the same readings again; nothing where none does.

    Readings under the same circumstances, in every column of the data, are the same each time only if they are copies.

    Args:
        problem: the model on its data.
    """
    found = []
    for name, site in problem.declaration.observed.items():
        count = int(problem.observed.counted[name].sum())
        if count > _MOST or not is_continuous(problem.families[name]):
            continue
        if again := _copies(problem, name, site):
            what = f"{again} of {count} values of {site.argument or name} are others again, the same in every column"
            found.append(f"{what}: {READ_TWICE} They count as independent; leave copies out")
    return found


def _copies(problem: Problem, name: str, site: Site) -> int:
    """How many readings are copies; none where circumstances are unknown, or readings under the same ones differ."""
    counted = problem.observed.counted[name]
    values = np.asarray(problem.observed.values[name])[counted]
    given = [np.broadcast_to(column, site.shape)[counted] for column in all_columns(problem, site).values()]
    if not given or not values.size:
        return 0
    _, circumstances = np.unique(np.stack(given, axis=1), axis=0, return_inverse=True)
    _, first, count = np.unique(
        np.stack([circumstances.reshape(-1), values], axis=1), axis=0, return_index=True, return_counts=True
    )
    again, met = int((count - 1).sum()), len(values) - int(circumstances.max()) - 1
    several = len(np.unique(values[first[count > 1]]))
    return again if again >= _ALL * met and min(again, several) >= _FEWEST else 0
