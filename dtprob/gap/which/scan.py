"""Candidates that first-order scores cannot see: effects that turn phases by radians at plausible sizes.

Every effect is tried at four sizes; where the log likelihood is not the parabola that its first two sizes promise, the
effect is scanned over its whole plausible range. The rewritten sites go through the base model as perturbations, so no
candidate needs a compilation of its own. Where clusters have coordinates of their own with several optima (a link's delay
where only powers are seen), whole effects are tried with these found anew: a swap of two transmitters explains nothing
while delays and gains stand where the wrong one put them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.plausible import WHOLE, nulls, scales, sides, sizes
from dtprob.gap.fitting.sweep import combined, elsewhere
from dtprob.gap.model.problem import Problem
from dtprob.gap.model.tangents import CHUNK
from dtprob.gap.which.directions import Surroundings, surroundings

_REACH = 2.5
_COARSE = 32
_EVEN = np.linspace(-_REACH, _REACH, 160)
_NEAR = np.geomspace(1e-3, 0.15, 32)
_FINE = np.concatenate([_EVEN, _NEAR, -_NEAR])
"""Sizes of effects that turn phases, in standard deviations of the prior: small ones closer together (a wrong carrier)."""
_WAVES = 3
_SCANNED = 2
_SMALL, _LARGE = 0.02, 1.0
_BENT = 0.4
_DRAWS = 64
_STEPS = 21
_WIDE = 128
"""Entries of a site up to which each is looked at for one that matters most."""


type _Portion = tuple[str, slice, Mapping[str, jax.Array]]
"""An effect, which of its trials, and the shifts of sites in each of them."""


@dataclass(frozen=True)
class Found:
    """The best size of an effect along its plausible range: gain in log likelihood there, nuisances, flat parameters."""

    gain: float
    x: np.ndarray
    parameters: np.ndarray


def scan(
    problem: Problem, x: np.ndarray, names: Sequence[str], middle: np.ndarray | None = None
) -> dict[str, Found]:
    """Effects that bend the log likelihood, each at its best plausible size.

    The nuisances stand once at the fit and once at the centre of their prior: a fit without the effect may have silenced
    the very part of the model that the effect acts on.

    Args:
        problem: the model and candidates on their data.
        x: the fit.
        names: candidates to look at.
        middle: the centre of the prior, where it is known already; see `centre`.
    """
    means = _means(problem, names)
    small = {e.name: _lines(e, np.array([_SMALL, 2 * _SMALL, _LARGE, -_LARGE])) for e in means}
    found: dict[str, Found] = {}
    for anchor in (x, centre(problem, x) if middle is None else middle):
        around = surroundings(problem, anchor)
        here = float(problem.compiled.shifted(anchor, {}, 1)[0].sum())
        probed = _likelihoods(problem, around, small)
        bent = [e for e in means if _is_bent(probed[e.name] - here, sides(e)[sizes(e)[:_SCANNED]])]
        lines, likelihoods = _scanned(problem, around, bent, np.linspace(-_REACH, _REACH, _COARSE))
        waves = [e for e in bent if _is_wave(likelihoods[e.name])]
        for part, values in zip(_scanned(problem, around, waves, _FINE), (lines, likelihoods), strict=True):
            values.update(part)
        for name, values in likelihoods.items():
            best = int(np.argmax(_finite(values)))
            gain = float(values[best]) - here
            if name not in found or gain > found[name].gain:
                found[name] = Found(gain, anchor, lines[name][best])
    return found


def scan_anew(problem: Problem, x: np.ndarray, names: Sequence[str]) -> dict[str, Found]:
    """Effects that gain at their whole size with clusters' own coordinates where they are best then; see `elsewhere`.

    Args:
        problem: the model and candidates on their data.
        x: the fit, or the centre of the prior, since the fit may have bent what clusters share to what the twin lacks; it
            stays there.
        names: candidates to look at.
    """
    effects = _means(problem, names)
    by_cluster = problem.compiled.by_cluster
    others = elsewhere(problem, x, by_cluster)
    if not others:
        return {}
    points = [x, *(point for point, _ in others)]
    here = float(np.fmax.reduce([by_cluster(x), *(terms for _, terms in others)]).sum())
    lines = {
        e.name: _lines(e, np.array([WHOLE] if sides(e)[sizes(e)].all() else [-WHOLE, WHOLE])) for e in effects
    }
    best = {name: np.full((len(line), problem.n_cluster), -np.inf) for name, line in lines.items()}
    chosen = {name: np.zeros(terms.shape, int) for name, terms in best.items()}
    for i, point in enumerate(points):
        for name, part, terms in _terms(problem, surroundings(problem, point), lines):
            chosen[name][part] = np.where(terms > best[name][part], i, chosen[name][part])
            best[name][part] = np.maximum(terms, best[name][part])
    found = {}
    for name, line in lines.items():
        total = best[name].sum(axis=1)
        k = int(np.argmax(total))
        if total[k] > here:
            x_there = combined(problem, points, chosen[name][k])
            found[name] = Found(float(total[k]) - here, x_there, line[k])
    return found


def _means(problem: Problem, names: Sequence[str]) -> list[Effect]:
    return [e for e in problem.effects if e.kind == "mean" and e.rewrites and e.name in names]


def centre(problem: Problem, x: np.ndarray) -> np.ndarray:
    """Base nuisances at the centre of their prior, but for the one whose move back to the fit matters most (the noise).

    Of sites of few entries: many are levels or states, none of which matters most.
    """
    draws = problem.prior_draws(jax.random.key(0), _DRAWS)
    middle = x.copy()
    blocks = [b for b in problem.blocks_of(None) if not b.local]
    for block in blocks:
        middle[block.index[0]] = np.median(draws[:, block.index[0]], axis=0)
    best, found = _finite(problem.compiled.profile(middle[None]))[0], middle
    for position in (i for b in blocks if b.size <= _WIDE for i in b.index[0]):
        line = np.repeat(middle[None], _STEPS + 1, axis=0)
        line[:, position] = [*np.quantile(draws[:, position], np.linspace(0.02, 0.98, _STEPS)), x[position]]
        values = _finite(problem.compiled.profile(line))
        if values.max() > best:
            best, found = values.max(), line[int(values.argmax())]
    return found


def _finite(values: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(values), values, -np.inf)


def _scanned(
    problem: Problem, around: Surroundings, effects: Sequence[Effect], offsets: np.ndarray
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Flat parameters at each effect's sizes, in standard deviations of its prior, and the log likelihoods there."""
    lines = {e.name: _lines(e, offsets) for e in effects}
    return lines, _likelihoods(problem, around, lines)


def _is_wave(values: np.ndarray) -> bool:
    """Whether a coarse line has so many peaks that it may miss some."""
    lines = values.reshape(-1, _COARSE)
    inner = lines[:, 1:-1]
    return bool(np.max(np.sum((inner > lines[:, :-2]) & (inner >= lines[:, 2:]), axis=1)) >= _WAVES)


def _lines(effect: Effect, offsets: np.ndarray) -> np.ndarray:
    """Flat parameters (trial, parameter): each of the first few sizes moved by offsets, in prior standard deviations."""
    null, scale, sided = nulls(effect), scales(effect), sides(effect)
    lines = []
    for j in sizes(effect)[:_SCANNED]:
        line = np.repeat(null[None], len(offsets), axis=0)
        line[:, j] += (np.abs(offsets) if sided[j] else offsets) * scale[j]
        lines.append(line)
    return np.concatenate(lines)


def _likelihoods(
    problem: Problem, around: Surroundings, sizes: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    found = {name: np.full(len(rows), -np.inf) for name, rows in sizes.items()}
    for name, part, terms in _terms(problem, around, sizes):
        found[name][part] = terms.sum(axis=1)
    return found


def _terms(
    problem: Problem, around: Surroundings, sizes: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, slice, np.ndarray]]:
    """What clusters add to the log posterior (trial, cluster) at some trials of an effect; what is not finite is -inf."""
    for portions in _packed(problem.programs.trial_shifts(around.grown(), sizes)):
        starts = np.cumsum([0, *(part.stop - part.start for _, part, _ in portions)])
        shifts: dict[str, np.ndarray] = {}
        for start, (_, _, own) in zip(starts[:-1], portions, strict=True):
            for site, shift in own.items():
                into = shifts.setdefault(site, np.zeros((starts[-1], *shift.shape[1:]), shift.dtype))
                into[start : start + len(shift)] = shift
        values = problem.compiled.shifted(around.x, shifts, int(starts[-1]))
        values = np.nan_to_num(values, nan=-np.inf, posinf=-np.inf)
        for (name, part, _), terms in zip(portions, np.split(values, starts[1:-1]), strict=True):
            yield name, part, terms


def _packed(portions: Iterable[_Portion]) -> Iterator[list[_Portion]]:
    """Trials of one effect after another together, as many as go through the model at a time."""
    packed: list[_Portion] = []
    for portion in portions:
        if sum(part.stop - part.start for _, part, _ in [*packed, portion]) > CHUNK:
            yield packed
            packed = []
        packed.append(portion)
    if packed:
        yield packed


def _is_bent(change: np.ndarray, sided: Bool[np.ndarray, " line"]) -> bool:
    """Whether the change of log likelihood at a large size is not what two small sizes promise, on any line.

    One that has only one side is tried at the same size twice.
    """
    for (one, two, plus, minus), is_sided in zip(change.reshape(-1, 4), sided, strict=True):
        curvature = (two - 2 * one) / (2 * _SMALL**2)
        slope = one / _SMALL - curvature * _SMALL
        sign = np.array([1.0, 1.0 if is_sided else -1.0])
        promised = sign * slope * _LARGE + curvature * _LARGE**2
        if not np.all(np.isfinite([plus, minus])):
            return True
        if np.max(np.abs(promised - [plus, minus])) > _BENT * np.max(np.abs([plus, minus])) + 1.0:
            return True
    return False
