"""Which set of effects: conditional forward steps, each candidate refitted in full from several starts.

First-order scores choose whom to try; the full refit decides, so a large gap, where expansions no longer hold, is judged
by the model itself. After each accepted effect everything is re-centred at the new fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import jax
import numpy as np

from dtprob.effects.effect import Effect
from dtprob.gap import fit as fitting
from dtprob.gap.bootstrap import replicate
from dtprob.gap.problem import Problem
from dtprob.gap.projection import Projection, project
from dtprob.gap.refit import polished, refit, starting_points, without
from dtprob.gap.scan import Found, scan
from dtprob.gap.screen import Screening, screen
from dtprob.gap.settings import Settings
from dtprob.gap.where import Location, locate

type Say = Callable[[str], None]

_LARGEST_FIELD = 256
"""Entries of a field per cluster up to which it is fitted entry by entry."""
_LARGEST_TANGENTS = 100_000_000
"""Numbers that the tangents of a field may take: 0.8 GB."""
_PREFERRED = 0.9
"""Share of a random field's evidence at which an effect with parameters of its own is preferred."""
_RETURNS = 3
"""Times that a search may find its starting fit to be no optimum."""
_LARGE_GAP = 100.0
"""Nats above which first-order scores may miss the effect that matters."""


@dataclass(frozen=True)
class View:
    """A fit seen from all sides: what it leaves, which candidates it calls for, where."""

    problem: Problem
    fitted: fitting.Fit
    projection: Projection
    screening: Screening
    location: Location


@dataclass(frozen=True)
class Step:
    """One step of the search: the view of the fit before, the refits that were tried, and the accepted one."""

    view: View
    problem: Problem
    trials: dict[str, fitting.Fit]
    accepted: str | None


def view(problem: Problem, fitted: fitting.Fit, key: jax.Array, settings: Settings) -> View:
    """Screen all candidates and map the gap at a fit, on one bootstrap."""
    projection = project(problem, fitted)
    drawn = replicate(problem, fitted, projection, key, settings)
    screening = screen(problem, fitted, projection, drawn, settings)
    return View(problem, fitted, projection, screening, locate(problem, fitted, projection, drawn))


def search(problem: Problem, base: fitting.Fit, key: jax.Array, settings: Settings, say: Say) -> list[Step]:
    """Forward steps from the base fit until nothing is significant or worth its prior; the last step accepts nothing.

    Args:
        problem: the model and candidates on their data.
        base: the fit of the model alone.
        key: for the bootstrap.
        settings: level, number of refits and largest set.
        say: receives one line at each stage.
    """
    steps: list[Step] = []
    fitted, returns = base, 0
    while True:
        say(
            f"screening {len(problem.effects)} effects"
            + (f" beside {', '.join(fitted.effects)}" * bool(fitted.effects))
        )
        seen = view(problem, fitted, jax.random.fold_in(key, len(steps)), settings)
        if len(steps) == settings.max_effects or not alarmed(seen, settings):
            return [*steps, Step(seen, problem, {}, None)]
        if steps and _promise(seen) < settings.minor * (fitted.log_evidence - base.log_evidence):
            return [*steps, Step(seen, problem, {}, None)]
        problem, trials = _trials(seen, settings, say, first=not steps)
        better = without(problem, seen.fitted, trials, settings.polished) if returns < _RETURNS else None
        if better is not None:
            say("found a better fit without them: starting again from there")
            fitted, base, returns = better, base if steps else better, returns + 1
            continue
        accepted = _accept(seen, base, trials, settings)
        steps.append(Step(seen, problem, trials, accepted))
        if accepted is None:
            return steps
        fitted = trials[accepted]


def _promise(seen: View) -> float:
    """Nats that the best candidate or site could still bring, to first order."""
    return max(
        float(seen.screening.log_bayes_factor.max(initial=0.0)),
        max((s.gain for s in seen.location.sites), default=0.0),
    )


def alarmed(seen: View, settings: Settings) -> bool:
    """Whether the effects' scores or the site tests show a gap at the level."""
    level = settings.level / 2
    return float(seen.screening.adjusted.min(initial=1.0)) <= level or seen.location.site_p_value <= level


def _accept(
    seen: View, base: fitting.Fit, trials: Mapping[str, fitting.Fit], settings: Settings
) -> str | None:
    """The refit with the largest evidence, if it outweighs the choice among all candidates and is no minor matter.

    A random field can imitate nearly anything, so an effect with parameters of its own is preferred when it reaches a good
    part of the evidence; what the field would add on top is left to the next step.
    """
    if not trials:
        return None
    fitted, kinds = seen.fitted, {e.name: e.kind for e in seen.problem.effects}
    gain = {name: trial.log_evidence - fitted.log_evidence for name, trial in trials.items()}
    best = max(gain, key=lambda name: gain[name])
    plain = {name: value for name, value in gain.items() if kinds[name] == "mean"}
    if plain and max(plain.values()) >= _PREFERRED * gain[best]:
        best = max(plain, key=lambda name: plain[name])
    so_far = fitted.log_evidence - base.log_evidence
    needed = max(np.log(len(kinds)) + 3.0, settings.minor * so_far)
    return best if gain[best] > needed else None


def _trials(
    seen: View, settings: Settings, say: Say, *, first: bool
) -> tuple[Problem, dict[str, fitting.Fit]]:
    """Refits of the most promising candidates, in a problem in which they are live."""
    screening, fitted = seen.screening, seen.fitted
    found: dict[str, Found] = {}
    if first and _promise(seen) > _LARGE_GAP:
        say("scanning the effects' plausible sizes")
        found = scan(seen.problem, seen.fitted.x, screening.names)
    scanned = np.array([found[n].gain if n in found else -np.inf for n in screening.names])
    chosen = _chosen(seen, scanned, settings)
    problem = seen.problem.with_live([*fitted.effects, *chosen])
    start = replace(fitted, x=problem.translate(fitted.x, seen.problem))
    effects = {e.name: e for e in problem.effects}
    trials = {}
    for name in chosen:
        say(f"refitting with {name}")
        starts = starting_points(problem, start.x, effects[name], screening.step.get(name), settings)
        if name in found:
            starts.append(_scanned_start(problem, seen.problem, effects[name], found[name]))
        trials[name] = refit(problem, start, effects[name], starts)
    return problem, polished(problem, fitted, trials, settings.polished)


def _scanned_start(problem: Problem, scanned: Problem, effect: Effect, found: Found) -> np.ndarray:
    x = problem.translate(found.x, scanned)
    x[problem.layout.indices(effect.site_name(p.name) for p in effect.parameters)] = found.parameters
    return x


def _chosen(seen: View, scanned: np.ndarray, settings: Settings) -> list[str]:
    """The best candidates by score and, in equal number, by the scan."""
    screening = seen.screening
    able = [
        i
        for i, name in enumerate(screening.names)
        if screening.absorbed_by[i] is None and _affordable(seen.problem, name)
    ]
    by_score = sorted(
        (i for i in able if screening.log_bayes_factor[i] > 0), key=lambda i: -screening.log_bayes_factor[i]
    )
    by_scan = sorted((i for i in able if scanned[i] > 3.0), key=lambda i: -scanned[i])
    half = settings.candidates // 2
    chosen = dict.fromkeys([*by_score[:half], *by_scan[:half], *by_score[half:], *by_scan[half:]])
    return [screening.names[i] for i in list(chosen)[: settings.candidates]]


def _affordable(problem: Problem, name: str) -> bool:
    """Whether a field is small enough to be fitted entry by entry."""
    effect = next(e for e in problem.effects if e.name == name)
    if effect.kind == "mean":
        return True
    size = int(np.prod(problem.field_shapes[name], dtype=int)) // problem.n_cluster
    return size <= _LARGEST_FIELD and size * problem.rows.gather.size <= _LARGEST_TANGENTS
