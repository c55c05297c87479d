"""Which set of effects: conditional forward steps, each candidate refitted in full, earlier choices looked at again.

First-order scores choose whom to try; the full refit decides, so a large gap, where expansions no longer hold, is judged
by the model itself. After each accepted effect everything is re-centred at the new fit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import jax
import numpy as np

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.bound import bound
from dtprob.gap.fitting.refit import BETTER, without
from dtprob.gap.keys import key_for
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.view import View, view
from dtprob.gap.which.classes import IDLE
from dtprob.gap.which.stand_in import stands_in
from dtprob.gap.which.starts import beside, exchanged, promising, refitted_with, refitted_without
from dtprob.gap.which.trials import Say, Start, Trials, as_good, best, credit, remembered, tried

_RETURNS: Final = 3
"""Times that a search may find its starting fit to be no optimum."""
_REVISIONS: Final = 4
"""Earlier choices that are looked at again after each step."""
_REVISED: Final = 5
"""Effects that are refitted in full where an earlier choice is looked at again, beside that choice, at most."""
_WITHIN: Final = 0.25
"""Share of what another way gained by which one may fall short of it for its choices to be looked at again."""
_MISSED: Final = 6.0
"""Times what first-order scores promise that a refit may gain."""


@dataclass(frozen=True)
class Step:
    """One step of the search: the view of the fit before, the refits that were tried, and the accepted one."""

    view: View
    trials: Trials
    accepted: str | None

    @property
    def end(self) -> Start:
        """The fit with the effect that was accepted, or the one of the view."""
        if self.accepted is None:
            return Start(self.view.problem, self.view.fitted)
        return self.trials.at(self.accepted)


@dataclass(frozen=True)
class Search:
    """What a search did.

    Attributes:
        steps: from the base fit until nothing is significant or worth its prior; the last step accepts nothing.
        rivals: where the ways ended that were not taken in the end.
    """

    steps: list[Step]
    rivals: tuple[Start, ...] = ()


def search(problem: Problem, base: fitting.Fit, key: jax.Array, settings: Settings, say: Say) -> Search:
    """Look for the effects that are missing, one after another; of several ways the one whose end has most credit stands.

    Where a random field was accepted, which can imitate several effects at once, the search goes on without it too, but not
    without one whose place was found, which can imitate little. Where a pair promises as much as was reached, the search
    starts from that pair, or puts it in the place of two effects beside others. What one family of a site beats, a single
    effect by far, is taken back: it stands in for what is not known.

    Args:
        problem: the model and candidates on their data.
        base: the fit of the model alone.
        key: for the bootstrap.
        settings: level, number of refits and largest set.
        say: receives one line at each stage.
    """
    steps = _forward(problem, base, key, settings, say)
    bare, end = steps[0].view, steps[-1].view
    base = bare.fitted
    ways = [steps]
    fields = {e.name: e for e in problem.effects if e.kind == "variance"}
    field = next((name for name in end.fitted.effects if name in fields), None)

    def go_on(start: Start, key: jax.Array, goal: float, begun: Step | None = None) -> list[Step]:
        """The steps from another start, which are one more way."""
        found = _forward(
            start.problem, start.fitted, key, settings, say, base=base, banned=field, goal=goal, begun=begun
        )
        ways.append([*steps[:-1], *found])
        return found

    if field is not None and not fields[field].is_looked_for:
        say(f"looking for effects that {field} may have imitated")
        rest = refitted_without(end.problem, end.fitted, field)
        key = key_for(key, "without the field")
        goal = credit(problem, end.fitted, base)
        others = go_on(rest, key, goal, _without_trial(steps[0], rest.fitted, field))
        both = beside([step.view for step in others], field, _reached(problem, ways, base), base, settings)
        if both is not None:
            key = key_for(key, "beside the field")
            go_on(both, key, goal)
    reached = _reached(problem, ways, base)
    pair = promising(bare, [way[-1].view for way in ways], reached - base.log_evidence, settings)
    if pair is not None:
        say(f"starting from {pair[0]} and {pair[1]} together")
        both = refitted_with(bare, pair, settings)
        key = key_for(key, "pair")
        if not bound(both.problem, both.fitted):
            go_on(both, key, reached)
    reached = _reached(problem, ways, base)
    other = _exchanged(problem, ways, reached, base, settings, say=say)
    if other is not None:
        go_on(other, key_for(key, "exchange"), reached)
    ways = _ranked(problem, ways, base)
    if stands_in(bare, ways[0][-1].view, base, field, say):
        ways.insert(0, [Step(bare, Trials(bare.problem, {}), None)])
    ends = [way[-1].view for way in ways]
    return Search(ways[0], tuple(Start(e.problem, e.fitted) for e in ends[1:] if e.fitted.effects))


def _exchanged(
    problem: Problem,
    ways: Sequence[Sequence[Step]],
    reached: float,
    base: fitting.Fit,
    settings: Settings,
    *,
    say: Say,
) -> Start | None:
    """The best pair in the place of two effects that were found, beside the rest; None if it is no better than they are."""
    views, ends = [step.view for way in ways for step in way], [way[-1].view for way in ways]
    fits: list[Start] = []
    for seen, pair in exchanged(views, ends, reached, base, settings):
        say(f"refitting with {pair[0]} and {pair[1]} beside {', '.join(seen.fitted.effects)}")
        fits.append(refitted_with(seen, pair, settings))
    better = [one for one in fits if credit(problem, one.fitted, base) > reached + BETTER]
    best_fit = max(better, key=lambda one: credit(problem, one.fitted, base), default=None)
    return None if best_fit is None or bound(best_fit.problem, best_fit.fitted) else best_fit


def _ranked(problem: Problem, ways: Sequence[list[Step]], base: fitting.Fit) -> list[list[Step]]:
    """The way whose end has most credit first, but one before it whose end lacks effects that bring hardly any."""
    ends = [(credit(problem, way[-1].view.fitted, base), way) for way in ways]
    ends.sort(key=lambda end: -end[0])
    most, best_way = ends[0]
    effects = set(best_way[-1].view.fitted.effects)
    plainer = (
        way
        for worth, way in ends
        if set() < set(way[-1].view.fitted.effects) < effects and worth > most - IDLE
    )
    first = next(plainer, best_way)
    return [first, *(way for _, way in ends if way is not first)]


def _reached(problem: Problem, ways: Sequence[Sequence[Step]], base: fitting.Fit) -> float:
    """The most credit that a way ended with."""
    return max(credit(problem, way[-1].view.fitted, base) for way in ways)


def _forward(
    problem: Problem,
    start: fitting.Fit,
    key: jax.Array,
    settings: Settings,
    say: Say,
    *,
    base: fitting.Fit | None = None,
    banned: str | None = None,
    goal: float = -np.inf,
    begun: Step | None = None,
) -> list[Step]:
    """Steps from a fit, which may have effects already, each followed by a look at earlier choices.

    Such looks may lead in a circle, since what is given up is judged otherwise than what is taken: the one with most credit
    is its end. Where there is a goal, a credit that another way has reached already, steps too short for it are not taken,
    and earlier choices are looked at again near it only. What was begun is a step from the same fit, whose view and refits
    are taken over.
    """
    steps: list[Step] = []
    fitted, returns = begun.view.fitted if begun else start, 0
    base = start if base is None else base
    visited: dict[frozenset[str], View] = {}
    while True:
        if frozenset(fitted.effects) in visited:
            most = max(visited.values(), key=lambda view: credit(view.problem, view.fitted, base))
            return [*steps, Step(most, Trials(most.problem, {}), None)]
        seen = (
            begun.view
            if begun
            else _looked(problem, fitted, key_for(key, f"step {len(steps)}"), settings, say)
        )
        little = seen.promise < settings.minor * (fitted.log_evidence - base.log_evidence)
        if (
            little
            or _is_hopeless(seen, base, goal, settings, banned)
            or len(fitted.effects) == settings.max_effects
            or not seen.alarmed(settings)
        ):
            return [*steps, Step(seen, Trials(problem, {}), None)]
        visited[frozenset(fitted.effects)] = seen
        earlier = remembered(steps[0].view, steps[0].trials, seen) if steps else {}
        trials = begun.trials if begun else tried(seen, settings, say, banned=banned, earlier=earlier)
        problem = trials.problem
        may_return = returns < _RETURNS and begun is None
        better = without(problem, seen.fitted, trials.fits, settings.polished) if may_return else None
        begun = None
        if better is not None:
            say("found a better fit without them: starting again from there")
            del visited[frozenset(fitted.effects)]
            fitted, base, returns = better, base if fitted.effects else better, returns + 1
            continue
        accepted = best(seen, base, trials.fits, settings)
        steps.append(Step(seen, trials, accepted))
        if accepted is None:
            return steps
        near = (1 - _WITHIN) * goal + _WITHIN * base.log_evidence
        if credit(problem, trials.fits[accepted], base) > near:
            keys = key_for(key, f"revision {len(steps)}")
            steps += _revised(tuple(steps), base, keys, settings, say, banned=banned)
        reached = steps[-1].end
        problem, fitted = reached.problem, reached.fitted


def _without_trial(step: Step, fitted: fitting.Fit, name: str) -> Step | None:
    """A step from the same fit whose refits do without one effect; None from another fit, or where no refit is left."""
    before = step.view.fitted
    if fitted.effects != before.effects or fitted.log_evidence > before.log_evidence + BETTER:
        return None
    rest = {other: one for other, one in step.trials.fits.items() if other != name}
    return replace(step, trials=replace(step.trials, fits=rest), accepted=None) if rest else None


def _is_hopeless(seen: View, base: fitting.Fit, goal: float, settings: Settings, banned: str | None) -> bool:
    """Whether further steps do not reach a credit, each of them some times what the best candidate promises.

    Not beside no effect yet, where scans may find what first-order scores miss.
    """
    if not np.isfinite(goal) or not seen.fitted.effects:
        return False
    screening = seen.screening
    promises = zip(screening.names, screening.log_bayes_factor, strict=True)
    most = max((float(promise) for name, promise in promises if name != banned), default=0.0)
    left = settings.max_effects - len(seen.fitted.effects)
    return credit(seen.problem, seen.fitted, base) + _MISSED * left * max(most, 0.0) < goal


def _looked(
    problem: Problem,
    fitted: fitting.Fit,
    key: jax.Array,
    settings: Settings,
    say: Say,
    *,
    located: bool = True,
) -> View:
    beside = f" beside {', '.join(fitted.effects)}" if fitted.effects else ""
    say(f"screening {len(problem.effects)} effects{beside}")
    return view(problem, fitted, key, settings, located=located)


def _revised(
    steps: Sequence[Step],
    base: fitting.Fit,
    key: jax.Array,
    settings: Settings,
    say: Say,
    *,
    banned: str | None,
) -> Iterator[Step]:
    """Every other effect once more, beside the ones chosen since: kept, or another one in its place, or none.

    The first choice was made while the other effects were still in the data, and may have been made for them. What was as
    good as it then is looked at beside it.
    """
    last, before = steps[-1], [step.trials for step in steps]
    looked = {frozenset(last.view.fitted.effects)}
    settings = replace(settings, candidates=min(settings.candidates, _REVISED))
    for i in range(_REVISIONS):
        reached = last.end
        chosen = reached.fitted.effects
        left_out = next((e for e in chosen if frozenset(chosen) - {e} not in looked), None)
        if left_out is None:
            return
        rest = refitted_without(reached.problem, reached.fitted, left_out)
        looked.add(frozenset(rest.fitted.effects))
        again = key_for(key, f"look {i}")
        # chosen by scores alone
        seen = _looked(rest.problem, rest.fitted, again, settings, say, located=False)
        rivals = as_good(left_out, before, seen)
        trials = tried(seen, settings, say, {left_out: reached}, banned=banned, earlier=rivals)
        before.append(trials)
        last = Step(seen, trials, best(seen, base, trials.fits, settings))
        yield last
