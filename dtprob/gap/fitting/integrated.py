"""Integrating out what each cluster has of its own, where a mode over all unknowns at once would be wrong.

Such a mode is drawn to where the clusters' own unknowns have most room: a state for every reading lets the noise vanish,
the spread of levels grows as these shrink. Integrated out they add a volume to the density, which every fit takes
along; see `marginal_mode`.
"""

from __future__ import annotations

from typing import Final

import jax
import numpy as np

from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.base import fit_base, followed
from dtprob.gap.fitting.density import terms_of
from dtprob.gap.fitting.fit import Fit, fit
from dtprob.gap.fitting.marginal_mode import (
    Around,
    about_the_mode,
    around,
    beside,
    fitted_at,
    height_at,
    steps,
)
from dtprob.gap.fitting.states import each_has_states, held, states
from dtprob.gap.fitting.sweep import turned
from dtprob.gap.fitting.unwound import unwound
from dtprob.gap.model.problem import Problem
from dtprob.gap.which.trials import Say, Start

_MATTERS: Final = 4.0
"""Squared distance of a joint mode from the marginal one, in standard deviations, from which it is not taken."""
_RUNAWAY: Final = 10.0
"""Standard deviations of the prior beyond which a joint mode runs away, unless it arrives at a sound one."""
_FURTHER: Final = 5
"""Fits by which such a mode may arrive."""


def based(problem: Problem, key: jax.Array, *, polished: int = 3, say: Say = lambda _: None) -> Start:
    """The base fit: the joint mode, or where that is too far from the marginal one, the latter.

    Args:
        problem: the model on its data, without live effects.
        key: for prior draws.
        polished: how many of the fits are freed from local optima.
        say: told where unknowns are integrated out.

    Raises:
        InputError: the model has no finite likelihood from any start; what breaks is named.
    """
    shared, has_states = held(problem), bool(states(problem).blocks)
    if not (has_states or activate(problem).local_index.shape[1]) or not len(shared):
        return Start(problem, fit_base(problem, key, polished=polished))
    centre, free = turned(problem, problem.prior_spread.middle, problem.compiled.by_cluster), around(problem)
    starts = [centre, *unwound(problem, centre)]
    at_once = has_states or each_has_states(problem)
    if not at_once and not _runs_away(problem, fit(problem, centre), centre, free):
        joint = fit_base(problem, key, polished=polished)
        if not _runs_away(problem, joint, centre, free):
            if _is_near_the_marginal_one(problem, joint, free):
                return Start(problem, joint)
            starts.append(joint.x)
    say(f"integrating out {'states' if has_states else 'what each cluster has of its own'}")
    here, height = max((height_at(problem, x, free) for x in starts), key=lambda found: found[1])
    mode = about_the_mode(problem, here, height, free)
    found = fitted_at(problem, mode, free, followed)
    return Start(found.within(problem), found)


@np.errstate(over="ignore", invalid="ignore")  # a runaway's curvatures may overflow: it is not near
def _is_near_the_marginal_one(problem: Problem, joint: Fit, free: Around) -> bool:
    """Whether a joint mode is no farther from the marginal one than what the data tell apart."""
    near = steps(free, joint)
    up, down = beside(problem, joint.x, free, near)
    slope = (up - down).sum(axis=0) / (2 * near)
    return bool(slope @ joint.covariance @ slope < _MATTERS)


def _runs_away(problem: Problem, first: Fit, centre: np.ndarray, free: Around) -> bool:
    """Whether a joint mode that was sought from a sound point lies where no prior expects it, or nowhere.

    What data say of a twin that is far off lies there too: such a fit arrives, and the marginal mode is where it does.
    """
    if first.converged or not np.isfinite(terms_of(problem, activate(problem), centre)).all():
        return False
    if not np.isfinite(first.log_posterior):
        return True
    away = np.abs(first.x - centre)[first.global_index] / free.scale
    if away.max() <= _RUNAWAY:
        return False
    arrived = followed(problem, first, patience=_FURTHER)
    return not (arrived.converged and _is_near_the_marginal_one(problem, arrived, free))
