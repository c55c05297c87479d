"""Which set of effects: conditional forward steps, each candidate refitted in full, earlier choices looked at again.

First-order scores choose whom to try; the full refit decides, so a large gap, where expansions no longer hold, is judged
by the model itself. After each accepted effect everything is re-centred at the new fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import jax

from dtprob.gap import fit as fitting
from dtprob.gap.problem import Problem
from dtprob.gap.refit import at_null_except, without
from dtprob.gap.settings import Settings
from dtprob.gap.trials import Say, Start, Trials, best, credit, tried
from dtprob.gap.view import View, view

_RETURNS: Final = 3
"""Times that a search may find its starting fit to be no optimum."""
_REVISIONS: Final = 4
"""Earlier choices that are looked at again after each step."""


@dataclass(frozen=True)
class Step:
    """One step of the search: the view of the fit before, the refits that were tried, and the accepted one."""

    view: View
    trials: Trials
    accepted: str | None


def search(problem: Problem, base: fitting.Fit, key: jax.Array, settings: Settings, say: Say) -> list[Step]:
    """Steps from the base fit until nothing is significant or worth its prior; the last step accepts nothing.

    Where a random field was accepted, which can imitate several effects at once, the search goes on without it too, and the
    set of more credit stands.

    Args:
        problem: the model and candidates on their data.
        base: the fit of the model alone.
        key: for the bootstrap.
        settings: level, number of refits and largest set.
        say: receives one line at each stage.
    """
    steps = _forward(problem, base, key, settings, say)
    end, base = steps[-1].view, steps[0].view.fitted
    kinds = {e.name: e.kind for e in problem.effects}
    field = next((name for name in end.fitted.effects if kinds[name] == "variance"), None)
    if field is None:
        return steps
    say(f"looking for effects that {field} may have imitated")
    rest = _refitted_without(end.problem, end.fitted, field)
    others = _forward(end.problem, rest, jax.random.fold_in(key, 1), settings, say, base=base, banned=field)
    with_it, without_it = (credit(problem, one.fitted, base) for one in (end, others[-1].view))
    return [*steps[:-1], *others] if without_it >= with_it else steps


def _forward(
    problem: Problem,
    start: fitting.Fit,
    key: jax.Array,
    settings: Settings,
    say: Say,
    *,
    base: fitting.Fit | None = None,
    banned: str | None = None,
) -> list[Step]:
    """Steps from a fit, which may have effects already, each followed by a look at earlier choices."""
    steps: list[Step] = []
    fitted, returns = start, 0
    base = start if base is None else base
    while True:
        seen = _looked(problem, fitted, jax.random.fold_in(key, len(steps)), settings, say)
        little = seen.promise < settings.minor * (fitted.log_evidence - base.log_evidence)
        if little or len(fitted.effects) == settings.max_effects or not seen.alarmed(settings):
            return [*steps, Step(seen, Trials(problem, {}), None)]
        trials = tried(seen, settings, say, banned=banned)
        problem = trials.problem
        better = without(problem, seen.fitted, trials.fits, settings.polished) if returns < _RETURNS else None
        if better is not None:
            say("found a better fit without them: starting again from there")
            fitted, base, returns = better, base if fitted.effects else better, returns + 1
            continue
        accepted = best(seen, base, trials.fits, settings)
        steps.append(Step(seen, trials, accepted))
        if accepted is None:
            return steps
        keys = jax.random.fold_in(key, 1000 + len(steps))
        steps += _revised(steps[-1], base, keys, settings, say, banned=banned)
        problem, fitted = steps[-1].trials.problem, _outcome(steps[-1])


def _looked(problem: Problem, fitted: fitting.Fit, key: jax.Array, settings: Settings, say: Say) -> View:
    beside = f" beside {', '.join(fitted.effects)}" if fitted.effects else ""
    say(f"screening {len(problem.effects)} effects{beside}")
    return view(problem, fitted, key, settings)


def _outcome(step: Step) -> fitting.Fit:
    return step.view.fitted if step.accepted is None else step.trials.fits[step.accepted]


def _revised(
    last: Step, base: fitting.Fit, key: jax.Array, settings: Settings, say: Say, *, banned: str | None
) -> Iterator[Step]:
    """Every other effect once more, beside the ones chosen since: kept, or another one in its place, or none.

    The first choice was made while the other effects were still in the data, and may have been made for them.
    """
    looked = {frozenset(last.view.fitted.effects)}
    for i in range(_REVISIONS):
        problem, fitted = last.trials.problem, _outcome(last)
        left_out = next((e for e in fitted.effects if frozenset(fitted.effects) - {e} not in looked), None)
        if left_out is None:
            return
        rest = _refitted_without(problem, fitted, left_out)
        looked.add(frozenset(rest.effects))
        seen = _looked(problem, rest, jax.random.fold_in(key, i), settings, say)
        trials = tried(seen, settings, say, {left_out: Start(problem, fitted)}, banned=banned)
        last = Step(seen, trials, best(seen, base, trials.fits, settings))
        yield last


def _refitted_without(problem: Problem, fitted: fitting.Fit, name: str) -> fitting.Fit:
    """The fit with all its effects but one."""
    others = tuple(e for e in fitted.effects if e != name)
    return fitting.fit(problem, at_null_except(problem, fitted, others), others, spread=fitted.spread)
