"""Whether predictions of clusters that a fit has not seen are as uncertain as they should be.

To first order in what is not known: parameters have their posterior from the other clusters, random weights that each
cluster has of its own have their prior, and so has what the base fit integrates out (states). What the base model refits in
every cluster anyway (phases, levels) is refitted.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import stats

from dtprob.gap.fitting.active import Active, activate, basis
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.newton import positive
from dtprob.gap.fitting.projection import project
from dtprob.gap.how_far.closed import Fold
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation.likelihoods import likelihood

_WIDEST: Final = 2.0
"""Log spread beyond which the noise's own spread is not followed."""
_LEVEL: Final = 0.9
_ABSORBED: Final = 0.05
"""Share of a residual's variance that a refit must leave for it to be looked at."""


@dataclass(frozen=True)
class Calibration:
    """Predicted against actual errors, on clusters that were left out; None where they refit all that they show.

    Attributes:
        coverage: share of observed entries that count inside their 90% predictive interval; None where not all are normal.
        error_ratio: root mean square of errors over predicted standard deviations, 1 if they are right; None where outcomes
            are observed. The probability p of an outcome says how much it varies, p (1 - p), however uncertain p itself is:
            outcomes one by one vary no more where a gap is, and no less than predicted once it is allowed for (McCullagh
            and Nelder, Generalized Linear Models, 1989, section 4.4.5).
    """

    coverage: float | None
    error_ratio: float | None


def calibration(problem: Problem, folds: Iterable[Fold]) -> Calibration:
    """Calibration of predictions of held-out clusters.

    Args:
        problem: on whose data the fits were made.
        folds: which clusters were left out, and the fits to the others.
    """
    located = problem.rows.is_location & (problem.rows.of_entries(problem.observed.counted) > 0)
    inside, squares = [], []
    families: set[str] = set()
    for held, part, _ in folds:
        predicted = _predicted(problem, part, held)
        seen = located[held] & (predicted.sd > _ABSORBED**0.5)
        scaled, swing = predicted.error[seen] / predicted.sd[seen], predicted.swing[seen]
        inside.append(np.abs(scaled) <= _reach(swing))
        squares.append(scaled**2 * np.exp(-2 * swing**2))
        families |= {o.family for o in problem.compiled.observations(part.x).values()}
    known = [likelihood(family) for family in families]
    each, squared = np.concatenate(inside), np.concatenate(squares)
    if not each.size:
        return Calibration(None, None)
    coverage = None if any(f.log_scale is None for f in known) else float(each.mean())
    ratio = None if any(f.is_outcome for f in known) else float(np.sqrt(squared.mean()))
    return Calibration(coverage, ratio)


class _Predicted(NamedTuple):
    """Whitened errors (held-out cluster, row), their standard deviations, and those of the logarithm of the noise."""

    error: np.ndarray
    sd: np.ndarray
    swing: np.ndarray


def _predicted(problem: Problem, part: Fit, held: np.ndarray) -> _Predicted:
    """Errors of held-out clusters, whose own random weights are at zero, and how large they should be."""
    active = activate(problem, part.effects, spread=part.spread)
    x, root, drawn = _own(problem, part, active)
    directions = basis(problem, active)
    e, w = (np.asarray(v)[held] for v in problem.compiled.linearised(x, directions))
    slope, hessian = problem.compiled.prior(x, directions)
    n, index = len(active.global_index), active.local_index[held]
    local, random = w[..., n:][..., ~drawn], w[..., n:][..., drawn] @ root[held][:, drawn]
    places = index[:, ~drawn]
    curvature = np.einsum("cmi,cmj->cij", local, local)
    curvature = curvature + np.moveaxis(hessian[n:][~drawn][:, places], 0, 1)
    inverse = np.linalg.inv(positive(curvature)) if local.shape[-1] else curvature
    pull = np.einsum("cmi,cij->cmj", local, inverse)
    score = np.einsum("cmi,cm->ci", local, e) + slope[places]
    unknown = np.concatenate([w[..., :n] @ _root(part.covariance), random], axis=-1)
    left = unknown - np.einsum("cmi,cki,ckj->cmj", pull, local, unknown)
    # what a refit leaves of noise and of the prior's own spread together, whose rows have variance 1 + local prior local'
    noise = 1 - np.einsum("cmi,cmi->cm", pull, local)
    variance = np.maximum(noise + (left**2).sum(-1), 0.0)
    return _Predicted(
        e - np.einsum("cmi,ci->cm", pull, score), np.sqrt(variance), _swing(problem, unknown, held)
    )


def _own(problem: Problem, part: Fit, active: Active) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What clusters have of their own: a flat vector with the random ones at their centre, roots, which are random.

    Effects' weights are random; of the base model those that its fit integrates out are. Roots are of their
    covariances (cluster, local, local).
    """
    x, index = part.x.copy(), active.local_index
    blocks = [b for b in active.blocks if b.local]
    weights = [0.0 if b.owner is None else part.spread[b.owner] for b in blocks]
    root = np.tile(np.diag(np.repeat(weights, [b.size for b in blocks])), (problem.n_cluster, 1, 1))
    base = np.repeat([b.owner is None for b in blocks], [b.size for b in blocks]).astype(bool)
    x[index[:, ~base]] = 0.0
    if problem.volume is None:
        return x, root, ~base
    prior = project(problem, part)
    x[index[:, base]] = prior.origin[index[:, base]]
    root[:, base] = prior.own.root[:, base]
    return x, root, ~base | (np.einsum("cii->ci", root) > 0).all(axis=0)


def _swing(problem: Problem, unknown: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Standard deviation of the logarithm of the noise's own (held-out cluster, row), at rows of a location."""
    rows = np.zeros((problem.n_cluster, unknown.shape[1]))
    rows[held] = (unknown**2).sum(-1)
    found = {}
    for name, own in problem.rows.by_site(rows).items():
        scale, spread = likelihood(problem.families[name]).log_scale, problem.located[name]
        swing = (
            np.zeros_like(own)
            if scale is None
            else np.broadcast_to(scale * np.sqrt(own[spread : spread + 1]), own.shape)
        )
        found[name] = jnp.asarray(swing)
    return np.minimum(np.asarray(problem.rows.stack(found))[held], _WIDEST)


def _root(covariance: np.ndarray) -> np.ndarray:
    """A square root of a covariance."""
    return np.linalg.cholesky(positive(covariance)) if len(covariance) else covariance


def _reach(swing: np.ndarray) -> np.ndarray:
    """Bound of 90% of normal values whose standard deviation is log-normal, of median 1 and log spread `swing`."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(61)
    grid = np.linspace(0.0, _WIDEST, 61)
    bounds = np.geomspace(0.5, 1e3, 400)
    shares = (2 * stats.norm.cdf(bounds[:, None] * np.exp(-grid[:, None, None] * nodes)) - 1) @ weights
    shares = shares / weights.sum()
    table = [float(np.interp(_LEVEL, one, bounds)) for one in shares]
    return np.interp(swing, grid, table)
