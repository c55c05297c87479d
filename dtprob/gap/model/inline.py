"""Observations whose values the model computes without naming them: no site stands for what may be wrong there."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.gap.model.problem import Problem

_SEED: Final = 7
"""Of perturbations, any of which tells what moves with a site."""
_ALIKE: Final = 8
"""Values that one entry of a site may stand for, as it does for repeated readings."""


def unnamed(problem: Problem, x: Float[np.ndarray, " dimension"], alike: float = _ALIKE) -> frozenset[str]:
    """Observed sites whose values no deterministic site moves that has an entry for each of them, or for a few.

    A site that is named and not used, one of spreads, or a level of many readings leaves the readings' own values unlooked
    at.

    Args:
        problem: the model on its data.
        x: where it is looked at.
        alike: how many values one entry of a site may stand for.
    """
    observed, random = problem.declaration.observed, np.random.default_rng(_SEED)
    left = set(observed)
    for name, site in reversed(problem.float_sites.items()):
        enough = {n for n in left if site.size * alike >= observed[n].size}
        if not enough:
            continue
        step = random.normal(size=(1, *site.shape)).astype(site.dtype)
        shift = np.asarray(problem.compiled.site_shift(x, {name: step}))[..., 0]
        moved = problem.rows.by_site(np.where(problem.rows.is_location, shift, 0.0))
        left -= {n for n in enough if moved[n].any()}
    return frozenset(left)
