"""What is left of data and of candidates once a fit has moved everything that it is free to move, to first order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Final

import jax
import numpy as np

from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.active import Active, activate, basis, effect_prior
from dtprob.gap.fitting.centred import MOST, Centred
from dtprob.gap.fitting.columns import apart, product, rows_of, rows_of_each, scores
from dtprob.gap.fitting.known import Known, along_secants, known_of, secants
from dtprob.gap.fitting.newton import positive
from dtprob.gap.fitting.states import are_states
from dtprob.gap.model.problem import Problem
from dtprob.gap.model.quick import quick_jit

_TOGETHER: Final = 32
"""Clusters whose projected columns are held at once."""
_FEWEST_DRAWN: Final = 64
"""Numbers of a replicate that are drawn at least."""
_MOST_BESIDE: Final = 1024
"""Own unknowns of all clusters up to which they are centred together with states."""
_AMPLIFIED: Final = 5.0
"""Times that rows of the same scores are larger at the centre of states, from which on scores are not taken there."""
_ROUNDING: Final = 1e-9
"""What is left of a coordinate after its fit is taken back, as a share of the fit, is zero below this."""


@dataclass(frozen=True)
class Projection:
    """Whitened tangents of everything that a fit moved, and what removes them from rows and from columns.

    Attributes:
        columns: tangents of the global coordinates (cluster, row, global).
        local_columns: tangents of the local ones (cluster, row, local).
        local_inverse: inverse curvature of the local ones (cluster, local, local).
        global_inverse: inverse curvature of the global ones, the local ones eliminated.
        reduced: tangents of the global ones after that elimination.
        shared: what the prior knows of the global coordinates.
        own: what it knows of the local ones.
        origin: the flat vector of the fit, with what the prior knows at its centre.
        centre: how scores are centred on the prior of the local ones, where it tells something of them.
    """

    columns: np.ndarray
    local_columns: np.ndarray
    local_inverse: np.ndarray
    global_inverse: np.ndarray
    reduced: np.ndarray
    shared: Known
    own: Known
    origin: np.ndarray
    centre: Centred | None

    def before_fit(self, residual: np.ndarray) -> np.ndarray:
        """Rows (cluster, row) with all coordinates back at the centre of their prior, to first order.

        A mode is drawn towards its prior, so that its residuals are not those of data whose coordinates were drawn from it:
        only after this are data and replicates alike.
        """
        return (
            residual
            + self.columns @ self.shared.deviation
            + rows_of_each(self.local_columns, self.own.deviation)
        )

    def with_prior(self, rows: np.ndarray, keys: jax.Array) -> np.ndarray:
        """Rows (replicate, cluster, row) to which the prior's spread of all coordinates is added, by replicates' keys."""
        shared, own = (
            np.einsum("...ij,r...j->r...i", part.root, _normal(keys, which, part.deviation.shape))
            for which, part in enumerate((self.shared, self.own))
        )
        return rows + rows_of(self.columns, shared) + rows_of_each(self.local_columns, own)

    def alone(self, chosen: np.ndarray) -> np.ndarray:
        """Covariance of some of the global coordinates, chosen by a mask (global,), the others of them held."""
        both = np.ix_(chosen, chosen)
        across = self.global_inverse[chosen][:, ~chosen]
        held = np.linalg.solve(self.global_inverse[np.ix_(~chosen, ~chosen)], across.T)
        return self.global_inverse[both] - across @ held

    def rows(self, e: np.ndarray) -> np.ndarray:
        """Rows (..., cluster, row) after the linearised refit of all nuisances."""
        e = e - rows_of(self.columns, scores(self.reduced, e) @ self.global_inverse.T)
        return e - self._moved_alone(e)

    def adjust(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Effect columns (cluster, row, k) after projection, and B's part that falls on the global nuisances."""
        coefficients = self.global_inverse @ product(self.reduced, w)
        return self.without_own(w) - self.reduced @ coefficients, coefficients

    def information(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """W' P W and B's part that falls on the global nuisances, of effect columns W (cluster, row, k).

        P W, the columns after projection, are made of a few clusters at a time.
        """
        parts = [slice(low, low + _TOGETHER) for low in range(0, len(w), _TOGETHER)]
        coefficients = self.global_inverse @ product(self.reduced, w)
        found = np.zeros((w.shape[-1], w.shape[-1]))
        for c in parts:
            adjusted = self.without_own(w[c], c) - self.reduced[c] @ coefficients
            found += product(w[c], adjusted)
        return found, coefficients

    def without_own(self, w: np.ndarray, clusters: slice = slice(None)) -> np.ndarray:
        """Columns (cluster, row, k) of some clusters, their local coordinates projected away."""
        own = self.local_columns[clusters]
        if not own.shape[-1]:
            return w
        return w - own @ (self.local_inverse[clusters] @ (np.swapaxes(own, 1, 2) @ w))

    def adjoint(self, e: np.ndarray) -> np.ndarray:
        """Rows P' e (..., cluster, row), whose products with columns W are those of e with P W."""
        return (
            e - self._moved_alone(e) - rows_of(self.reduced, scores(self.reduced, e) @ self.global_inverse.T)
        )

    def _moved_alone(self, e: np.ndarray) -> np.ndarray:
        """What a refit of the local coordinates alone moves of rows (..., cluster, row)."""
        own = self.local_columns
        score = apart(e) @ own @ np.swapaxes(self.local_inverse, 1, 2)
        return np.moveaxis(score @ np.swapaxes(own, 1, 2), 0, -2).reshape(e.shape)


@partial(quick_jit, static_argnames="size")
def _standard_normal(keys: jax.Array, which: int, size: int) -> jax.Array:
    return jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, which), (size,)))(keys)


def _normal(keys: jax.Array, which: int, shape: tuple[int, ...]) -> np.ndarray:
    """Standard normal numbers (key, *shape); drawn in powers of two, so that few programs serve all shapes."""
    count = int(np.prod(shape, dtype=int))
    if not count:
        return np.zeros((len(keys), *shape))
    size = max(_FEWEST_DRAWN, 1 << max(count - 1, 0).bit_length())
    return np.asarray(_standard_normal(keys, which, size))[:, :count].reshape(-1, *shape)


def project(problem: Problem, fitted: fitting.Fit) -> Projection:
    """Projection on the complement of everything that the fit is free to move."""
    active = activate(problem, fitted.effects, spread=fitted.spread)
    directions = basis(problem, active)
    n = len(active.global_index)
    w = np.asarray(problem.compiled.linearised(fitted.x, directions)[1])
    prior_slope, hessian = problem.compiled.prior(fitted.x, directions)
    _, effect_slope, effect_curvature = effect_prior(problem, active, fitted.x)
    w_global, w_local = np.ascontiguousarray(w[..., :n]), np.ascontiguousarray(w[..., n:])
    slope = prior_slope + effect_slope
    prior_global = hessian[:n][:, active.global_index] + np.diag(effect_curvature[active.global_index])
    prior_local = np.moveaxis(hessian[n:][:, active.local_index], 0, 1)
    told = np.zeros(problem.dimension)
    told[active.global_index] = np.einsum("cmg,cmg->g", w_global, w_global)
    told[active.local_index] = np.einsum("cml,cml->cl", w_local, w_local)
    secant = secants(problem, active, fitted.x, directions, slope=prior_slope, hessian=hessian, told=told)
    prior_global = along_secants(prior_global, secant[active.global_index])
    prior_local = along_secants(prior_local, secant[active.local_index])
    prior_local = prior_local + effect_curvature[active.local_index][..., None] * np.eye(
        prior_local.shape[-1]
    )
    shared = known_of(slope[active.global_index], prior_global, told[active.global_index])
    own = known_of(slope[active.local_index], prior_local, told[active.local_index])
    inner = are_states(problem, active)
    w_global, centre = (
        _centred_on_states(
            problem, active, fitted.x, directions, w_global=w_global, w_local=w_local, inner=inner, own=own
        )
        if problem.volume is not None and inner.any()
        else _centred(problem, active, fitted.x, directions, w_global=w_global, w_local=w_local, own=own)
    )
    transposed = np.swapaxes(w_local, 1, 2)
    local = transposed @ w_local + prior_local
    local_inverse = np.linalg.inv(positive(local)) if local.shape[-1] else local
    reduced = w_global - w_local @ (local_inverse @ (transposed @ w_global))
    curvature = product(w_global, reduced) + prior_global
    inverse = np.linalg.inv(positive(curvature)) if n else curvature
    origin = fitted.x.copy()
    origin[active.global_index] -= shared.deviation
    origin[active.local_index] -= own.deviation
    origin = np.where(np.abs(origin) < _ROUNDING * np.abs(fitted.x), 0.0, origin)
    return Projection(w_global, w_local, local_inverse, inverse, reduced, shared, own, origin, centre)


def _centred_on_states(
    problem: Problem,
    active: Active,
    x: np.ndarray,
    directions: np.ndarray,
    *,
    w_global: np.ndarray,
    w_local: np.ndarray,
    inner: np.ndarray,
    own: Known,
) -> tuple[np.ndarray, Centred | None]:
    """The same where the global coordinates of a mask are states that are integrated out, with what clusters own beside.

    Where data hardly depend on states at their centre, as on the weights of a network of which all are zero there, scores
    stay as they are at the fit.
    """
    beside = active.local_index.size <= _MOST_BESIDE
    there, at = x.copy(), active.global_index[inner]
    there[at] = problem.prior_spread.middle[at]
    if beside:
        there[active.local_index] -= own.deviation
    moved = np.asarray(problem.compiled.linearised(there, directions)[1])
    if not np.isfinite(moved).all():
        return w_global, None
    split = len(inner)
    parts = ((w_global, w_local), (moved[..., :split], moved[..., split:]))
    levels = slice(None if beside else 0)
    centre = Centred.of(there, *(_together(shared[..., inner], each[..., levels]) for shared, each in parts))
    if centre.amplified > _AMPLIFIED:
        return w_global, None
    columns = w_global.copy()
    columns[..., ~inner] = centre.columns(w_global[..., ~inner], moved[..., :split][..., ~inner])
    return columns, centre


def _together(shared: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Tangents (1, cluster and row, k) of what acts on all clusters, and of what acts on each alone."""
    clusters, rows, each = own.shape
    apart = np.zeros((clusters, rows, clusters, each))
    apart[np.arange(clusters), :, np.arange(clusters)] = own
    columns = (shared.reshape(clusters * rows, -1), apart.reshape(clusters * rows, -1))
    return np.concatenate(columns, axis=1)[None]


def _centred(
    problem: Problem,
    active: Active,
    x: np.ndarray,
    directions: np.ndarray,
    *,
    w_global: np.ndarray,
    w_local: np.ndarray,
    own: Known,
) -> tuple[np.ndarray, Centred | None]:
    """Tangents of the global coordinates, that go through the clusters' own as spread, not as a shift; the centre."""
    n, wanted = w_global.shape[2], own.root.any() and w_local.shape[2] <= MOST
    if not w_local.shape[2] or not (wanted or problem.volume):
        return w_global, None
    there = x.copy()
    there[active.local_index] -= own.deviation
    w = np.asarray(problem.compiled.linearised(there, directions if wanted else directions[:n])[1])
    if wanted and np.isfinite(w).all():
        centre = Centred.of(there, w_local, w[..., n:])
        return centre.columns(w_global, w[..., :n]), centre
    return w_global, None
