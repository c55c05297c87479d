"""Full refits of a model with one more effect, from several starting points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dtprob.effects.effect import Effect
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.base import local_maxima, polish
from dtprob.gap.fitting.marginal import settled
from dtprob.gap.fitting.marginal_mode import faithful
from dtprob.gap.fitting.plausible import LARGE, places, plausible_spread, scales, sides, sizes
from dtprob.gap.fitting.sweep import swept
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings

_LINES = 12
"""Parameters of an effect along which starting points are looked for."""
BETTER = 0.5
"""Nats by which another optimum has to be higher."""
_SWEPT = 3
"""Parameters of an effect whose large sizes are tried with the clusters' angles found anew."""
_SAME = 1.0
"""Nats by which a peak has to be higher than a start that the same hill leads from."""
_VANISHED = 1e-3
"""Share of its largest plausible spread below which a field has vanished; from a larger start it may not."""
_REACH = 0.4
"""Share of the best trial's gain in log evidence from which on another may still overtake it."""


def refit(problem: Problem, fitted: fitting.Fit, effect: Effect, starts: Sequence[np.ndarray]) -> fitting.Fit:
    """The best of several refits with one more effect.

    Args:
        problem: in which the effect is live.
        fitted: the fit without it.
        effect: what is added.
        starts: flat vectors; the field of a variance effect starts at zero, too, and spreads as far as it starts.
    """
    names = (*fitted.effects, effect.name)
    if effect.kind == "variance":
        index = problem.field_of(effect).index
        fits = [fitting.fit(problem, _at_null(problem, fitted.x, [effect.name]), names)]
        if fits[0].spread[effect.name] < _VANISHED * plausible_spread(effect):
            wide = {**fitted.spread, effect.name: plausible_spread(effect)}
            fits.append(fitting.fit(problem, _at_null(problem, fitted.x, [effect.name]), names, spread=wide))
        for x in starts:
            spread = {**fitted.spread, effect.name: float(np.sqrt(np.mean(x[index] ** 2)))}
            fits.append(fitting.fit(problem, x, names, spread=spread))
        return max(fits, key=lambda f: f.log_evidence)
    best = max((fitting.fit(problem, x, names) for x in starts), key=lambda f: f.log_evidence)
    return faithful(problem, settled(problem, best), starts)


def polished(
    problem: Problem, before: fitting.Fit, trials: Mapping[str, fitting.Fit], count: int
) -> dict[str, fitting.Fit]:
    """The trials, those in reach of the best freed from local optima.

    The fit without an effect may have bent nuisances far away to imitate it; the refit has to find the way back. Random
    fields are left as they are: they can do without.

    Args:
        problem: in which the trials' effects are live.
        before: the fit without them.
        trials: refits by the effect's name.
        count: so many at most are worked on.
    """
    kinds = {e.name: e.kind for e in problem.effects}
    gain = {name: one.log_evidence - before.log_evidence for name, one in trials.items()}
    reach = _REACH * max(gain.values(), default=0.0)
    able = [name for name in trials if kinds[name] == "mean" and gain[name] >= reach]
    best = sorted(able, key=lambda name: -gain[name])[:count]
    return {name: _polish(problem, one) if name in best else one for name, one in trials.items()}


def _polish(problem: Problem, fitted: fitting.Fit) -> fitting.Fit:
    """A fit freed from local optima; as it is where an expansion about it is all that keeps noise from vanishing."""
    return fitted if problem.volume is not None else polish(problem, fitted)


def without(
    problem: Problem, before: fitting.Fit, trials: Mapping[str, fitting.Fit], count: int
) -> fitting.Fit | None:
    """A fit without the tried effects that is better than the one before, found from where their refits went.

    A refit that gains because it left a local optimum of the nuisances says nothing of its effect.

    Args:
        problem: in which the trials' effects are live.
        before: the fit without them.
        trials: refits by the effect's name.
        count: so many at most are looked at, the best first.
    """
    best = sorted(trials, key=lambda name: -trials[name].log_evidence)[:count]
    fits = []
    for effect in problem.effects:
        if effect.name in best and effect.kind == "mean":
            x = _at_null(problem, trials[effect.name].x, [effect.name])
            fits.append(fitting.fit(problem, x, before.effects, spread=before.spread))
    found = max(fits, key=lambda f: f.log_evidence, default=before)
    return _polish(problem, found) if found.log_evidence > before.log_evidence + BETTER else None


def starting_points(
    problem: Problem, x: np.ndarray, effect: Effect, step: np.ndarray | None, settings: Settings
) -> list[np.ndarray]:
    """The one-step estimate, the best local maxima of the log posterior along each parameter, and large sizes.

    The last only where clusters have angles that are found together with other coordinates of theirs; see `swept`.

    Args:
        problem: in which the effect is live.
        x: the fit without it.
        effect: what is added.
        step: the one-step estimate of its parameters, if there is one.
        settings: how many trial sizes and starting points.
    """
    if effect.kind == "variance":
        return []
    index = problem.layout.of(effect)
    scale, sided = scales(effect), sides(effect)
    x = _at_null(problem, x, [effect.name])
    one_step = x.copy()
    if step is not None:
        moved = np.clip(step, -4 * scale, 4 * scale)
        one_step[index] += np.where(sided, np.maximum(moved, 1e-3 * scale), moved)
    local = places(effect)[:_LINES]
    lines = [(int(i), float(scale[j]), bool(sided[j])) for j, i in enumerate(index[:_LINES]) if not local[j]]
    reached, peaks = _along(problem, one_step, x, lines, settings)
    if local.any():  # they do nothing beside the null, so they are looked at beside the best size
        best = max([(reached, one_step), *peaks], key=lambda b: b[0])[1]
        edges = [(int(i), float(scale[j]), False) for j, i in enumerate(index[:_LINES]) if local[j]]
        peaks += _along(problem, best, best, edges, settings)[1]
    ordered = sorted(peaks, key=lambda b: -b[0])[: settings.starts]
    floor = reached if len(ordered) else -np.inf
    near = [start for value, start in ordered if value > floor - 5.0]
    return [one_step, *near, *_large(problem, x, effect, settings.starts)]


def _along(
    problem: Problem,
    point: np.ndarray,
    x: np.ndarray,
    lines: Sequence[tuple[int, float, bool]],
    settings: Settings,
) -> tuple[float, list[tuple[float, np.ndarray]]]:
    """The log posterior at a point, and the local maxima on lines through x: position, scale, and whether one-sided.

    The only one of a line is left out, since a climb from the point leads there, too, unless it is higher than the point.
    """
    half = np.linspace(-2.5, 2.5, 2 * settings.grid + 1)
    fine = np.geomspace(1e-3, 0.1, settings.grid // 4)
    steps = np.unique(np.concatenate([half, fine, -fine]))
    trials = []
    for position, scale, sided in lines:
        offsets = steps[steps >= 0] * scale if sided else steps * scale
        line = np.repeat(x[None], len(offsets), axis=0)
        line[:, position] += offsets
        trials.append(line)
    values = np.asarray(problem.compiled.profile(np.concatenate([point[None], *trials])))
    reached, low, peaks = float(values[0]), 1, []
    # of several lines none may lead through the point
    least = reached + _SAME if len(lines) == 1 else reached
    for line in trials:
        v = values[low : low + len(line)]
        low += len(line)
        tops = local_maxima(v)
        if len(tops) > 1 or v[tops].max(initial=-np.inf) > least:
            peaks += [(float(v[k]), line[k]) for k in tops]
    return reached, peaks


def _large(problem: Problem, x: np.ndarray, effect: Effect, count: int) -> list[np.ndarray]:
    """Large sizes of an effect that fit best with the clusters' angles found anew; none where `swept` has nothing to do."""
    index = problem.layout.of(effect)
    scale, sided = scales(effect), sides(effect)
    found: list[tuple[float, np.ndarray]] = []
    for j in sizes(effect)[:_SWEPT]:
        for size in LARGE[LARGE > 0] if sided[j] else LARGE:
            moved = x.copy()
            moved[index[j]] += size * scale[j]
            start = swept(problem, moved, problem.compiled.by_cluster)
            if start is moved:
                return []
            found.append((float(problem.compiled.by_cluster(start).sum()), start))
    finite = [one for one in found if np.isfinite(one[0])]
    return [start for _, start in sorted(finite, key=lambda f: -f[0])[:count]]


def at_null_except(problem: Problem, fitted: fitting.Fit, kept: Sequence[str]) -> np.ndarray:
    """The point of a fit with all its effects but those kept back at their null."""
    return _at_null(problem, fitted.x, [name for name in fitted.effects if name not in kept])


def _at_null(problem: Problem, x: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """The point with some effects at their null, where they are now: a place may have moved since it was last tried."""
    x, null = x.copy(), problem.null()
    for block in (block for name in names for block in problem.blocks_of(name)):
        x[block.index] = null[block.index]
    return x
