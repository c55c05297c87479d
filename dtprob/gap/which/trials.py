"""Refits with one more effect: of which candidates, and which of them is to be believed."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

import numpy as np
from scipy.special import gammaln

from dtprob.effects.effect import FIELD, Effect
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.bound import bound
from dtprob.gap.fitting.refit import polished, refit, starting_points
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.view import View
from dtprob.gap.which.each import scan_each
from dtprob.gap.which.scan import Found, centre, scan, scan_anew

type Say = Callable[[str], None]

_LARGEST_FIELD: Final = 256
"""Entries of a field per cluster up to which it is fitted entry by entry."""
_LARGEST_TANGENTS: Final = 100_000_000
"""Numbers that the tangents of a field may take: 0.8 GB."""
_FIELD_SHARE: Final = 0.03
"""Share of what was gained over the base fit that a random field has to be better by."""
_FIELD_NATS: Final = 3.0
"""Nats that it has to be better by in any case."""
_SURE: Final = 3.0
"""Nats that an effect has to bring where its score does not show it, beside those of the choice among all."""
_TOLD: Final = 0.5
"""Share of the nats that another candidate's score tells of that an effect has to bring to be what rang that alarm."""
_LIVE: Final = 12
"""Effects that are live at once, at most, where fewer are wanted."""
_HOPELESS: Final = 0.05
"""Share of the best candidate's promise below which another one is not refitted."""
_WORTH: Final = 3.0
"""Nats that an effect has to gain in a scan."""
_MUCH: Final = 0.1
"""Share of the best one's gain from which on a candidate is remembered."""
_REMEMBERED: Final = 2
"""Candidates that are remembered at most."""
_AS_GOOD: Final = 3.0
"""Nats that a candidate may have fallen short of another one that it was as good as."""
_POLISHED_LATER: Final = 1
"""New refits that are freed from local optima beside effects that are fitted already: the fit with these was freed, too."""
_LARGE_GAP: Final = 100.0
"""Nats above which first-order scores may miss the effect that matters."""
_HIDING_GAP: Final = 30.0
"""The same where clusters have own unknowns that are best elsewhere, which a fit without the effect has bent to hide it."""
_AT_FIT: Final = 1
"""Which of the scans is that of whole sizes at the fit. What gains there is no move of a nuisance, which the fit would have
made."""


@dataclass(frozen=True)
class Start:
    """A fit and the problem whose coordinates it is in."""

    problem: Problem
    fitted: fitting.Fit


@dataclass(frozen=True)
class Trials:
    """Refits by the name of the effect that each adds, in a problem in which all of these are live."""

    problem: Problem
    fits: Mapping[str, fitting.Fit]

    def at(self, name: str) -> Start:
        """The refit that adds an effect."""
        return Start(self.fits[name].within(self.problem), self.fits[name])


def remembered(before: View, trials: Trials, seen: View) -> dict[str, Found]:
    """Mean effects that gained much at an earlier step, at their sizes there, beside what has been accepted since.

    Scores at the null of one that has to be large may tell nothing of it.

    Args:
        before: the fit at that step.
        trials: refits there.
        seen: the fit now.
    """
    gain = {name: one.log_evidence - before.fitted.log_evidence for name, one in trials.fits.items()}
    least = max(_WORTH, _MUCH * max(gain.values(), default=0.0))
    return _first(_reached(trials, {name: nats for name, nats in gain.items() if nats > least}, seen))


def as_good(name: str, before: Iterable[Trials], seen: View) -> dict[str, Found]:
    """Mean effects that were as good as one where both were refitted, at their sizes there, the best first.

    Where that one is looked at again beside others, they are its rivals still, whatever their scores at the null say.

    Args:
        name: the one.
        before: refits at earlier steps.
        seen: the fit beside which it is looked at again.
    """
    found: dict[str, Found] = {}
    for trials in (one for one in before if name in one.fits):
        short = {n: one.log_evidence - trials.fits[name].log_evidence for n, one in trials.fits.items()}
        rivals = {n: nats for n, nats in short.items() if n != name and nats > -_AS_GOOD}
        found |= _reached(trials, rivals, seen)
    return _first(found)


def _reached(trials: Trials, gain: Mapping[str, float], seen: View) -> dict[str, Found]:
    """Those of some mean effects that a fit is without, at the sizes of their refits."""
    able = (e for e in seen.problem.effects if e.kind == "mean" and e.name not in seen.fitted.effects)
    return {
        e.name: Found(gain[e.name], seen.fitted.x, trials.fits[e.name].x[trials.problem.layout.of(e)])
        for e in able
        if e.name in gain
    }


def _first(found: Mapping[str, Found]) -> dict[str, Found]:
    """Those that gained most, the best first."""
    most = sorted(found, key=lambda name: -found[name].gain)
    return {name: found[name] for name in most[:_REMEMBERED]}


def tried(
    seen: View,
    settings: Settings,
    say: Say,
    known: Mapping[str, Start] = MappingProxyType({}),
    *,
    banned: str | None = None,
    earlier: Mapping[str, Found] = MappingProxyType({}),
) -> Trials:
    """Refits of the most promising candidates beside the effects of a view, without those that stay at their null.

    Args:
        seen: the fit, and what it calls for.
        settings: number of refits.
        say: receives one line for each.
        known: candidates to refit in any case, by name, with where to start.
        banned: a candidate that is not to be tried.
        earlier: candidates that gained much before, or were as good as another; see `remembered` and `as_good`.
    """
    screening, fitted = seen.screening, seen.fitted
    scans: list[dict[str, Found]] = []
    if not fitted.effects and seen.promise > _HIDING_GAP:
        say("scanning the effects' plausible sizes")
        scans = _scans(seen)
    chosen = [n for n in dict.fromkeys([*_chosen(seen, scans, settings, banned), *earlier]) if n not in known]
    problem = _together(seen.problem, [*fitted.effects, *known, *chosen])
    start = replace(fitted, x=problem.translate(fitted.x, seen.problem))
    effects = {e.name: e for e in problem.effects}
    trials = {name: _again(problem, at) for name, at in known.items()}
    for name in chosen:
        say(f"refitting with {name}")
        starts = starting_points(problem, start.x, effects[name], screening.step.get(name), settings)
        starts += [
            _scanned_start(problem, seen.problem, effects[name], found[name])
            for found in (*scans, earlier)
            if name in found
        ]
        trials[name] = refit(problem, start, effects[name], starts)
    count = min(settings.polished, _POLISHED_LATER) if fitted.effects else settings.polished
    new = {name: one for name, one in trials.items() if name not in known}
    every = {**trials, **polished(problem, start, new, count)}
    return Trials(problem, {name: one for name, one in every.items() if name not in bound(problem, one)})


def _scans(seen: View) -> list[dict[str, Found]]:
    """What far looks find where scores may miss it; where the gap is not large, those at clusters' own unknowns anew."""
    problem, x, names = seen.problem, seen.fitted.x, seen.screening.names
    middle, is_large = centre(problem, x), seen.promise > _LARGE_GAP
    return [
        scan(problem, x, names, middle) if is_large else {},
        scan_anew(problem, x, names),
        scan_anew(problem, middle, names),
        scan_each(problem, x, names, middle) if is_large else {},
    ]


def _again(problem: Problem, at: Start) -> fitting.Fit:
    """A fit once more in a problem in which other effects are live too."""
    volume, x = at.problem.volume_in(problem), problem.translate(at.fitted.x, at.problem)
    found = fitting.fit(problem.with_volume(volume), x, at.fitted.effects, spread=at.fitted.spread)
    return replace(found, volume=volume)


def _together(problem: Problem, names: Sequence[str]) -> Problem:
    """The problem with these effects live, and beside them some that were before: a later step may come back to them.

    Each set of live effects is compiled anew, so returning to one that is live already costs nothing.
    """
    before = [e.name for e in problem.live if e.kind == "mean" and e.name not in names]
    return problem.with_live([*names, *before[: max(_LIVE - len(names), 0)]])


def credit(problem: Problem, fitted: fitting.Fit, base: fitting.Fit) -> float:
    """Log evidence of a fit, less what its set has to be better by than a single effect.

    There are more sets of several effects than single ones: sets of every size are equally likely at first, and so are
    those of one size (Scott and Berger 2010). A random field pays besides: it can imitate nearly anything.

    Args:
        problem: whose effects were fitted.
        fitted: the fit.
        base: the fit of the model alone.
    """
    kinds = {e.name: e.kind for e in problem.effects}
    fields = sum(kinds[name] == "variance" for name in fitted.effects)
    gained = fitted.log_evidence - base.log_evidence
    sets = _log_sets(len(problem.effects), len(fitted.effects)) - _log_sets(len(problem.effects), 1)
    return fitted.log_evidence - max(sets, 0.0) - fields * max(_FIELD_NATS, _FIELD_SHARE * gained)


def _log_sets(candidates: int, size: int) -> float:
    """Log of the number of sets of a size."""
    return float(gammaln(candidates + 1) - gammaln(size + 1) - gammaln(candidates - size + 1))


def best(seen: View, base: fitting.Fit, trials: Mapping[str, fitting.Fit], settings: Settings) -> str | None:
    """The refit of most credit, if the choice among all candidates has been paid for and it is no minor matter.

    The family-wise level of its score pays, or that of another candidate whose score tells of no more than twice what the
    refit gains: that one may have stood for it. Else, as where only the sites have rung the alarm, the evidence has to.
    """
    if not trials:
        return None
    fitted = seen.fitted
    chosen = max(trials, key=lambda name: credit(seen.problem, trials[name], base))
    so_far = fitted.log_evidence - base.log_evidence
    gained = trials[chosen].log_evidence - fitted.log_evidence
    paid = seen.screening.pays_for(chosen, gained / _TOLD, settings)
    needed = max(0.0 if paid else np.log(len(seen.problem.effects)) + _SURE, settings.minor * so_far)
    return chosen if gained > needed else None


def _scanned_start(problem: Problem, scanned: Problem, effect: Effect, found: Found) -> np.ndarray:
    x = problem.translate(found.x, scanned)
    if effect.kind == "variance":
        x[problem.field_of(effect).index] = found.parameters
    else:
        x[problem.layout.of(effect)] = found.parameters
    return x


def _chosen(
    seen: View, scans: Sequence[Mapping[str, Found]], settings: Settings, banned: str | None
) -> list[str]:
    """The best candidates by score; where the gap is large, in turn with the best of two other lists, and each scan's best.

    One is of those that move what is expected: whatever is wrong looks like noise, which then has the largest scores. The
    other, at the first step, is by the scans, which do not start from the same likelihood, so that their gains cannot be
    compared: each has its turn. One that nuisances absorb nearly whole is left out unless what is left of it is an alarm.
    """
    screening = seen.screening
    at_fit = scans[_AT_FIT] if scans else {}
    able = [
        i
        for i, name in enumerate(screening.names)
        if (
            screening.absorbed_by[i] is None
            or screening.adjusted[i] <= settings.level / 2
            or (name in at_fit and at_fit[name].gain > _WORTH)
        )
        and name != banned
        and _affordable(seen.problem, name)
    ]
    by_score = _by_gain(able, screening.log_bayes_factor)
    if seen.promise <= _LARGE_GAP and not any(scans):
        return [screening.names[i] for i in by_score[: settings.candidates]]
    ranked = []
    for found in scans:
        gained = {i: found[screening.names[i]].gain for i in able if screening.names[i] in found}
        ranked.append(sorted((i for i in gained if gained[i] > _WORTH), key=lambda i: -gained[i]))
    locating = _by_gain([i for i in able if screening.locates[i]], screening.log_bayes_factor)
    chosen = _in_turn(by_score, locating, _in_turn(*ranked))[: settings.candidates]
    firsts = [scanned[0] for scanned in ranked if scanned]
    return [screening.names[i] for i in dict.fromkeys([*chosen, *firsts])]


def _by_gain(able: Sequence[int], gain: np.ndarray) -> list[int]:
    """Candidates by falling gain, down to a share of the best one's."""
    least = _HOPELESS * max((gain[i] for i in able), default=0.0)
    return sorted((i for i in able if gain[i] > max(least, 0.0)), key=lambda i: -gain[i])


def _in_turn(*lists: Sequence[int]) -> list[int]:
    """The first of each list, then the second of each, and so on, each entry once."""
    turns = itertools.zip_longest(*lists)
    return list(dict.fromkeys(i for turn in turns for i in turn if i is not None))


def _affordable(problem: Problem, name: str) -> bool:
    """Whether a field is small enough to be fitted entry by entry."""
    effect = next(e for e in problem.effects if e.name == name)
    if effect.kind == "mean":
        return True
    size = int(np.prod(problem.field_shapes[name], dtype=int))
    if problem.axis_of_clusters(effect) is not None or effect.site_name(FIELD) in problem.own:
        size //= problem.n_cluster
    return size <= _LARGEST_FIELD and size * problem.rows.gather.size <= _LARGEST_TANGENTS
