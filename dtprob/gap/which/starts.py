"""Where a search starts once more: from a pair that promises much, from a field beside others, with one effect less."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.marginal_mode import faithful
from dtprob.gap.fitting.refit import at_null_except, refit, starting_points
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.view import View
from dtprob.gap.which.trials import Start, credit

_NEARLY: Final = 3.0
"""Nats by which a pair may promise less than was reached, and by which it has to promise more than one effect."""
_UNDERSTATED: Final = 0.15
"""Share of a gain that first-order scores may miss."""
_BESIDE: Final = 4
"""Fits beside which a random field is fitted once more, at most."""
_EXCHANGED: Final = 3
"""Pairs that are fitted in place of what was found, at most."""


def promising(
    first: View, ends: Sequence[View], reached: float, settings: Settings
) -> tuple[str, str] | None:
    """The pair that promises most to first order, if it promises more than one effect, and as much as was reached.

    None where a way ended with it. First order understates: the base fit's spread holds the gap too. It overstates what
    noise explains, as which all of the gap counts at first: where what moves the mean leaves nothing, noise is no start.

    Args:
        first: the base fit.
        ends: where each way ended.
        reached: nats of credit over the base fit that the best way gained.
        settings: largest set, level.
    """
    found = [set(end.fitted.effects) for end in ends]
    if settings.max_effects < 2 or not any(found):
        return None
    pairs = first.screening.scores.pairs
    locating = first.screening.scores.locating
    if any(own <= locating and not end.alarmed(settings) for own, end in zip(found, ends, strict=True)):
        pairs = tuple(pair for pair in pairs if locating.issuperset(pair.names))
    if not pairs:
        return None
    best = pairs[0]
    alone = float(first.screening.scores.log_bayes_factor.max())
    enough = max(alone + np.log(len(first.problem.effects)) + _NEARLY, (1 - _UNDERSTATED) * reached - _NEARLY)
    new = not any(set(best.names) <= own for own in found)
    return best.names if new and best.log_bayes_factor > enough else None


def exchanged(
    views: Sequence[View], ends: Sequence[View], reached: float, base: fitting.Fit, settings: Settings
) -> list[tuple[View, tuple[str, str]]]:
    """Pairs beside a part of what was found that promise as much as all of it, the most promising first.

    Steps one after another may take two effects that are nearly right together, such as the gains of all elements but the
    first and of the first, where two plainer ones are right: a gain and a phase. Neither of these is best alone.

    Args:
        views: fits, some beside a part of what was found.
        ends: where each way ended.
        reached: the most credit that a way ended with.
        base: the fit of the model alone.
        settings: largest set.
    """
    known = [set(end.fitted.effects) for end in ends]
    promised: dict[frozenset[str], tuple[float, View, tuple[str, str]]] = {}
    for seen in views:
        own = set(seen.fitted.effects)
        if not own or len(own) + 2 > settings.max_effects or not any(own < found for found in known):
            continue
        least = reached - _NEARLY - _UNDERSTATED * (reached - credit(seen.problem, seen.fitted, base))
        for pair in seen.screening.scores.pairs:
            effects = (*seen.fitted.effects, *pair.names)
            evidence = seen.fitted.log_evidence + pair.log_bayes_factor
            promise = credit(seen.problem, replace(seen.fitted, effects=effects, log_evidence=evidence), base)
            if promise > least and not any(set(effects) <= found for found in known):
                promised[frozenset(effects)] = promise, seen, pair.names
    best = sorted(promised.values(), key=lambda one: -one[0])
    return [(seen, names) for _, seen, names in best[:_EXCHANGED]]


def beside(
    views: Sequence[View], field: str, reached: float, base: fitting.Fit, settings: Settings
) -> Start | None:
    """The best refit of a random field beside effects that were found without it, where both promise more than was reached.

    A field that was chosen first leaves nothing to see of the effects that it imitates beside what it is.

    Args:
        views: fits without the field, from the way that was taken without it.
        field: the random field.
        reached: the most credit that a way ended with.
        base: the fit of the model alone.
        settings: largest set, starting points.
    """
    promised: dict[tuple[str, ...], tuple[float, View]] = {}
    for seen in views:
        effects = (*seen.fitted.effects, field)
        if 1 < len(effects) <= settings.max_effects:
            evidence = seen.fitted.log_evidence + seen.screening.promise_of(field)
            promise = credit(seen.problem, replace(seen.fitted, effects=effects, log_evidence=evidence), base)
            promised[effects] = promise, seen
    most = sorted((one for one in promised.values() if one[0] > reached), key=lambda one: -one[0])[:_BESIDE]
    starts = [refitted_with(seen, (field,), settings) for _, seen in most]
    return max(starts, key=lambda one: credit(one.problem, one.fitted, base), default=None)


def refitted_with(seen: View, names: Sequence[str], settings: Settings) -> Start:
    """The fit of a view with further effects, each beside the ones before it, in the end all together."""
    problem = seen.problem.with_live([*seen.fitted.effects, *names])
    fitted = replace(seen.fitted, x=problem.translate(seen.fitted.x, seen.problem))
    effects = {e.name: e for e in problem.effects}
    for name in names:
        step = seen.screening.step.get(name) if fitted.effects == seen.fitted.effects else None
        starts = starting_points(problem, fitted.x, effects[name], step, settings)
        fitted = refit(problem, fitted, effects[name], starts)
    return Start(fitted.within(problem), fitted)


def refitted_without(problem: Problem, fitted: fitting.Fit, name: str) -> Start:
    """The fit with all its effects but one."""
    others = tuple(e for e in fitted.effects if e != name)
    x = at_null_except(problem, fitted, others)
    found = faithful(problem, fitting.fit(problem, x, others, spread=fitted.spread), [x])
    return Start(found.within(problem), found)
