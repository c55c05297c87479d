"""What is left of data and of candidates once a fit has moved everything that it is free to move, to first order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.gap import fit as fitting
from dtprob.gap.active import activate, basis, effect_prior
from dtprob.gap.newton import positive
from dtprob.gap.problem import Problem

_FAINT: Final = 1e-3
"""Share of the data's information on a coordinate below which its prior's is not looked at."""
_TOGETHER: Final = 32
"""Clusters whose projected columns are held at once."""
_ROUNDING: Final = 1e-9
"""What is left of a coordinate after its fit is taken back, as a share of the fit, is zero below this."""


class Known(NamedTuple):
    """What the prior knows of some coordinates.

    Attributes:
        deviation: of the fit from the prior's centre; 0 where the prior knows nothing.
        spread: standard deviation of the prior; 0 where it knows nothing.
    """

    deviation: np.ndarray
    spread: np.ndarray


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
    """

    columns: jax.Array
    local_columns: jax.Array
    local_inverse: jax.Array
    global_inverse: jax.Array
    reduced: jax.Array
    shared: Known
    own: Known
    origin: np.ndarray

    def before_fit(self, residual: jax.Array) -> jax.Array:
        """Rows (cluster, row) with all coordinates back at the centre of their prior, to first order.

        A mode is drawn towards its prior, so that its residuals are not those of data whose coordinates were drawn from it:
        only after this are data and replicates alike.
        """
        moved = jnp.einsum("cmg,g->cm", self.columns, self.shared.deviation)
        return residual + moved + jnp.einsum("cml,cl->cm", self.local_columns, self.own.deviation)

    def with_prior(self, rows: jax.Array, keys: jax.Array) -> jax.Array:
        """Rows (replicate, cluster, row) to which the prior's spread of all coordinates is added, by replicates' keys."""

        def drawn(which: int, spread: np.ndarray) -> jax.Array:
            return jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, which), spread.shape))(keys)

        shared, own = (
            drawn(which, part.spread) * part.spread for which, part in enumerate((self.shared, self.own))
        )
        rows = rows + jnp.einsum("cmg,rg->rcm", self.columns, shared)
        return rows + jnp.einsum("cml,rcl->rcm", self.local_columns, own)

    def rows(self, e: jax.Array) -> jax.Array:
        """Rows (..., cluster, row) after the linearised refit of all nuisances."""
        score = jnp.einsum("cmg,...cm->...g", self.reduced, e)
        e = e - jnp.einsum("cmg,gh,...h->...cm", self.columns, self.global_inverse, score)
        local = jnp.einsum("cml,...cm->...cl", self.local_columns, e)
        return e - jnp.einsum("cml,clk,...ck->...cm", self.local_columns, self.local_inverse, local)

    def adjust(self, w: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Effect columns (cluster, row, k) after projection, and B's part that falls on the global nuisances."""
        local = jnp.einsum("cml,cmk->clk", self.local_columns, w)
        w = w - jnp.einsum("cml,cli,cik->cmk", self.local_columns, self.local_inverse, local)
        cross = jnp.einsum("cmg,cmk->gk", self.reduced, w)
        coefficients = self.global_inverse @ cross
        return w - jnp.einsum("cmg,gk->cmk", self.reduced, coefficients), coefficients

    def information(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """W' P W and B's part that falls on the global nuisances, of effect columns W (cluster, row, k).

        P W, the columns after projection, are made of a few clusters at a time.
        """
        parts = [slice(low, low + _TOGETHER) for low in range(0, len(w), _TOGETHER)]
        cross = sum((_product(self.reduced[c], self._without_local(w[c], c)) for c in parts), np.zeros(()))
        coefficients = np.asarray(self.global_inverse) @ cross
        found = np.zeros((w.shape[-1], w.shape[-1]))
        for c in parts:
            adjusted = self._without_local(w[c], c) - np.asarray(self.reduced[c]) @ coefficients
            found += _product(w[c], adjusted)
        return found, coefficients

    def _without_local(self, w: np.ndarray, clusters: slice) -> np.ndarray:
        """Columns (cluster, row, k) of some clusters, their local coordinates projected away."""
        own = np.asarray(self.local_columns[clusters])
        if not own.shape[-1]:
            return w
        return w - own @ (np.asarray(self.local_inverse[clusters]) @ (np.swapaxes(own, 1, 2) @ w))

    def adjoint(self, e: jax.Array) -> jax.Array:
        """Rows P' e (..., cluster, row), whose products with columns W are those of e with P W."""
        score = jnp.einsum("cmg,...cm->...g", self.reduced, e)
        e = e - jnp.einsum("cmg,gh,...h->...cm", self.reduced, self.global_inverse, score)
        local = jnp.einsum("cml,...cm->...cl", self.local_columns, e)
        return e - jnp.einsum("cml,clk,...ck->...cm", self.local_columns, self.local_inverse, local)


def _product(left: Any, right: np.ndarray) -> np.ndarray:
    """Sum over clusters and rows of columns (cluster, row, i) times columns (cluster, row, j)."""
    entries = left.shape[0] * left.shape[1]
    return np.asarray(left).reshape(entries, left.shape[-1]).T @ right.reshape(entries, right.shape[-1])


def project(problem: Problem, fitted: fitting.Fit) -> Projection:
    """Projection on the complement of everything that the fit is free to move."""
    active = activate(problem, fitted.effects, spread=fitted.spread)
    directions = basis(problem, active)
    n = len(active.global_index)
    _, w = problem.compiled.linearised(fitted.x, directions)
    prior_slope, hessian = problem.compiled.prior(fitted.x, directions)
    _, effect_slope, effect_curvature = effect_prior(problem, active, fitted.x)
    w_global, w_local = w[..., :n], w[..., n:]
    local = np.asarray(jnp.einsum("cmi,cmj->cij", w_local, w_local))
    local = local + np.moveaxis(hessian[n:][:, active.local_index], 0, 1)
    for j in range(active.local_index.shape[1]):
        local[:, j, j] += effect_curvature[active.local_index[:, j]]
    local_inverse = jnp.asarray(np.linalg.inv(positive(local)) if local.shape[-1] else local)
    cross = jnp.einsum("cml,cmg->clg", w_local, w_global)
    reduced = w_global - jnp.einsum("cml,cli,cig->cmg", w_local, local_inverse, cross)
    curvature = np.asarray(jnp.einsum("cmi,cmj->ij", w_global, reduced))
    curvature = (
        curvature + hessian[:n][:, active.global_index] + np.diag(effect_curvature[active.global_index])
    )
    inverse = np.linalg.inv(positive(curvature)) if n else curvature
    slope = prior_slope + effect_slope
    flat = np.zeros(problem.dimension)
    flat[active.global_index] = np.diag(hessian[:n][:, active.global_index])
    flat[active.local_index] = np.einsum("jcj->cj", hessian[n:][:, active.local_index])
    flat = flat + effect_curvature
    shared, own = (
        _known(slope[index], flat[index], np.asarray(jnp.einsum(how, part, part)))
        for index, how, part in (
            (active.global_index, "cmg,cmg->g", w_global),
            (active.local_index, "cml,cml->cl", w_local),
        )
    )
    origin = fitted.x.copy()
    origin[active.global_index] -= shared.deviation
    origin[active.local_index] -= own.deviation
    origin = np.where(np.abs(origin) < _ROUNDING * np.abs(fitted.x), 0.0, origin)
    return Projection(w_global, w_local, local_inverse, jnp.asarray(inverse), reduced, shared, own, origin)


def _known(slope: np.ndarray, precision: np.ndarray, information: np.ndarray) -> Known:
    """From slope and precision of a log prior; what the data know far better counts as not known before."""
    informative = precision > _FAINT * information
    safe = np.where(informative, precision, 1.0)
    return Known(np.where(informative, -slope / safe, 0.0), np.where(informative, safe**-0.5, 0.0))
