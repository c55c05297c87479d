"""The fit of the base model that a diagnosis starts from."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import jax
import numpy as np

from dtprob.effects.rewriting import effects_of
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.active import means_among
from dtprob.gap.fitting.marginal import settled
from dtprob.gap.fitting.mirrored import mirrored
from dtprob.gap.fitting.soundness import broken
from dtprob.gap.fitting.sweep import turned
from dtprob.gap.fitting.unwound import unwound
from dtprob.gap.model.problem import Problem

_PRIOR_DRAWS = 64
_GRID = 121
_REACH = 3.0
_ROUNDS = 5
_PEAKS = 3
_MOST = 24
_SHORT = 4
_LONG = 3
_ENOUGH = 3
_SAME = 0.1
_PATIENCE = 40
_WIDE = 128
"""Entries of a site up to which other peaks are looked for along each; more are levels or states, not places."""
_COMPANION = (-1.0, -0.4, 0.0, 0.4, 1.0)


def fit_base(problem: Problem, key: jax.Array, starts: int = 8, polished: int = 3) -> fitting.Fit:
    """Posterior mode of the model without effects, the best of several starts.

    Effects that the model was extended by start at the centre of their prior, and other peaks along their parameters are
    looked for in any case: a displacement of half a wavelength is a local optimum.

    Args:
        problem: the model on its data.
        key: for prior draws.
        starts: the centre of the prior and at most this many less one draws from it; fewer where all lead to one mode.
        polished: how many of the fits, the best of each optimum, are freed from local optima; fewer where two of
            them end at one height.

    Raises:
        InputError: the model has no finite likelihood from any start; what breaks is named.
    """
    draws = problem.prior_draws(key, _PRIOR_DRAWS)
    added = [e.site_name(p.name) for e in effects_of(problem.model) for p in e.parameters]
    for block in (problem.layout[name] for name in added):
        draws[:, block.index] = np.median(draws[:, block.index], axis=0)
    fits = []
    middle = np.median(draws, axis=0)
    for x in [*unwound(problem, middle), middle, *draws[: starts - 1]]:
        fitted = fitting.fit(problem, turned(problem, x, problem.compiled.by_cluster))
        if np.isfinite(fitted.log_posterior):
            fits.append(fitted)
        values = [f.log_posterior for f in fits]
        # all of them: some may agree on a lower one of two modes
        if len(values) > _ENOUGH and max(values) - min(values) < _SAME:
            break
    if not fits:
        raise broken(problem, [middle, *draws[: starts - 1]])
    found = _apart(fits)
    freed: list[fitting.Fit] = []
    for fitted in found[:polished]:
        freed.append(polish(problem, fitted, freed=freed))
        if any(abs(freed[-1].log_posterior - other.log_posterior) < _SAME for other in freed[:-1]):
            break  # two starts that end at one height
    best = max([*freed, *found[polished:]], key=lambda f: f.log_posterior)
    best = settled(problem, followed(problem, best))
    return polish(problem, best, added) if added and not polished else best


def followed(problem: Problem, fitted: fitting.Fit, patience: int = _PATIENCE) -> fitting.Fit:
    """Where a fit that still climbs leads: along a bent ridge, as of a path's delay and its gain's phase, it crawls."""
    for _ in range(0 if fitted.converged else patience):
        further = fitting.fit(problem, fitted.x, fitted.effects, spread=fitted.spread)
        gain, fitted = further.log_posterior - fitted.log_posterior, further
        if fitted.converged or gain < _SAME:
            break
    return fitted


def _apart(fits: list[fitting.Fit]) -> list[fitting.Fit]:
    """One fit of each optimum, the best first."""
    kept: list[fitting.Fit] = []
    for fitted in sorted(fits, key=lambda f: -f.log_posterior):
        if not kept or kept[-1].log_posterior - fitted.log_posterior > _SAME:
            kept.append(fitted)
    return kept


def polish(
    problem: Problem,
    fitted: fitting.Fit,
    along: Collection[str] | None = None,
    freed: Sequence[fitting.Fit] = (),
) -> fitting.Fit:
    """Leave local optima: refit from the other peaks along each global nuisance, and mirrored, until none leads elsewhere.

    Args:
        problem: the model on its data.
        fitted: a mode.
        along: names of the nuisances to look along; all by default.
        freed: modes that no other peak is better than; where one of them is reached the search is over.
    """
    scale = problem.prior_draws(jax.random.key(0), _PRIOR_DRAWS).std(axis=0)
    means = means_among(problem, fitted.effects)  # in short fits random fields stay as they are
    for _ in range(_ROUNDS):
        if any(_is_same(fitted, one) for one in freed):
            return fitted
        peaks = _other_peaks(problem, fitted.x, scale, along)
        peaks += mirrored(problem, fitted.x) if along is None else []
        short = [fitting.fit(problem, x, means, steps=_SHORT) for x in peaks]
        short.sort(key=lambda f: -f.log_posterior)
        long = [fitting.fit(problem, f.x, fitted.effects, spread=fitted.spread) for f in short[:_LONG]]
        best = max(long, key=lambda f: f.log_posterior, default=fitted)
        if best.log_posterior < fitted.log_posterior + _SAME:
            return fitted
        before, fitted = fitted, best
        if _is_near(before, fitted):
            return fitted
    return fitted


def _is_same(one: fitting.Fit, other: fitting.Fit) -> bool:
    """Whether two fits have found the same mode."""
    return abs(one.log_posterior - other.log_posterior) < _SAME and _is_near(one, other)


def _is_near(one: fitting.Fit, other: fitting.Fit) -> bool:
    """Whether two fits are at one place, as far as the data tell places apart."""
    apart = (one.x - other.x)[one.global_index]
    return bool(apart @ np.linalg.solve(one.covariance, apart) < _SAME)


def _other_peaks(
    problem: Problem, x: np.ndarray, scale: np.ndarray, along: Collection[str] | None
) -> list[np.ndarray]:
    """The highest other peaks of the log posterior along each global nuisance, its companions moved along.

    Companions are the entries at the same place of nuisances in the same plates, as a material's conductivity is of its
    permittivity.
    """
    found: list[tuple[float, np.ndarray]] = []
    offsets = np.linspace(-_REACH, _REACH, _GRID)
    blocks = [b for b in problem.blocks_of(None) if not b.local]
    for block in (b for b in blocks if (b.size <= _WIDE if along is None else b.name in along)):
        plates = problem.declaration.sites[block.name].plates
        others = [
            b
            for b in blocks
            if b is not block and plates and problem.declaration.sites[b.name].plates == plates
        ]
        for j, position in enumerate(block.index[0]):
            lines = []
            for shift in _COMPANION if others else (0.0,):
                line = np.repeat(x[None], _GRID, axis=0)
                line[:, position] += offsets * scale[position]
                for other in others:
                    if other.size == block.size:
                        line[:, other.index[0][j]] += shift * scale[other.index[0][j]]
                lines.append(line)
            values = problem.compiled.profile(np.concatenate(lines)).reshape(len(lines), _GRID)
            found += _peaks(np.where(np.isfinite(values), values, -np.inf), np.stack(lines))
    return [point for _, point in sorted(found, key=lambda f: -f[0])[:_MOST]]


def local_maxima(values: np.ndarray) -> np.ndarray:
    """Places of the local maxima (n,) of values along a line, its ends among them; what is not finite is none."""
    padded = np.concatenate([[-np.inf], np.where(np.isfinite(values), values, -np.inf), [-np.inf]])
    return np.flatnonzero((padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:]))


def _peaks(values: np.ndarray, lines: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """The highest inner peaks, away from the middle, of the best line over companions."""
    best = values.max(axis=0)
    if np.ptp(best[np.isfinite(best)]) < 1.0:
        return []
    middle = _GRID // 2
    others = [int(k) for k in local_maxima(best) if abs(int(k) - middle) > 1]
    near = sorted(others, key=lambda k: abs(k - middle))[:_PEAKS]
    others = sorted({*near, *sorted(others, key=lambda k: -best[k])[:_PEAKS]})
    return [(float(best[k]), lines[int(values[:, k].argmax()), k]) for k in others]
