"""Whether what was found stands in for something that varies more simply at a site, and that no effect knows."""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.determined import shared_weights
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.marginal import marginal
from dtprob.gap.how_far.remainder import Alone, alone, beside
from dtprob.gap.view import View
from dtprob.gap.which.trials import Say, credit

_BETTER: Final = 3.0
"""Nats by which a family of a site has to be better than effects that may imitate it."""
_FAR: Final = 8.0
_FAR_SHARE: Final = 0.15
"""Nats, and share of what was gained, by which it has to be better than a single effect, real ones having other forms."""
_HALF: Final = 0.5
"""Share of a small gain that suffices: what leaves so much is the smaller part."""
_ALIKE: Final = 0.5
"""Parameters by which it is simpler than they are."""
_KEPT: Final = 0.5
"""Share of its gain that what was found keeps beside it where both are wrong."""


def stands_in(bare: View, end: View, base: Fit, field: str | None, say: Say) -> bool:
    """Whether one family of a site is better than what was found, by how much depends on what that can imitate.

    One that is no simpler has to explain more: of two forms of the same the effects' own stands, whatever their priors.
    What keeps its gain beside the best of them stands in for nothing: something else is wrong, too. The most promising
    families come first, and the first that leaves too little of the gain decides.

    Args:
        bare: the fit of the model alone.
        end: the fit with what was found.
        base: the fit that the gain is told from.
        field: a random field that may have imitated other effects.
        say: receives a line before fits.
    """
    found = end.fitted
    if not found.effects:
        return False
    worth = credit(bare.problem, found, base)
    may_imitate = len(found.effects) > 1 or found.effects == (field,)
    least = worth + (_BETTER if may_imitate else _lead(worth - base.log_evidence))
    verb = "stands" if len(found.effects) == 1 else "stand"
    doing = f"looking whether {' and '.join(found.effects)} {verb} in for what varies more simply at a site"
    effects = (effect for effect in end.problem.effects if effect.name in found.effects)
    fewest = sum(_freedom(end, effect) for effect in effects) - _ALIKE
    reached = cache(lambda: _likelihood(end))
    enough, most = _KEPT * (found.log_evidence - base.log_evidence), -np.inf
    for one in alone(bare, least, lambda: say(doing)):
        if one.fitted.log_evidence > most and (
            one.weights < fewest or _likelihood(one) > reached() + _BETTER
        ):
            most = one.fitted.log_evidence
            if beside(end, one) - most < enough:
                return True
    return False


def _lead(gain: float) -> float:
    """Nats by which a family has to be better than a single effect that has gained so many."""
    return max(_BETTER, min(max(_FAR, _FAR_SHARE * gain), _HALF * gain))


def _freedom(end: View, effect: Effect) -> float:
    """How many numbers an effect has to explain with; a random field those that the data determine."""
    if effect.kind == "mean":
        return effect.dimension
    is_own = end.problem.field_of(effect).local
    return np.inf if is_own else shared_weights(end.problem, end.fitted, effect.name)


def _likelihood(at: View | Alone) -> float:
    """Log likelihood of all clusters at a fit."""
    return float(marginal(at.problem, at.fitted).sum())
