"""One damped Newton step for global and cluster-local coordinates, the local ones eliminated cluster by cluster."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import linalg

_EDGES: Final = 8
"""Times that more coordinates are put on their edge before the others' step is taken as it is."""

_ENDLESS: Final = 1e100
"""Curvatures whose squares may still be multiplied are below."""
_SAFE: Final = 1e-5
"""Smallest diagonal of a Cholesky factor at which a scaled curvature is taken as it is."""


@dataclass(frozen=True)
class System:
    """Normal equations: gradient and curvature of the log posterior in global and local coordinates.

    Attributes:
        gradient: of the global coordinates, clusters weighted.
        local_gradient: (cluster, local).
        curvature: minus the Hessian of the global ones.
        cross: (cluster, global, local).
        local: (cluster, local, local).
        weights: of the clusters.
        bend: of the flat vector (dimension,), what effects' priors add to the curvatures' diagonals.
    """

    gradient: Float[np.ndarray, " global"]
    local_gradient: Float[np.ndarray, "cluster local"]
    curvature: Float[np.ndarray, "global global"]
    cross: Float[np.ndarray, "cluster global local"]
    local: Float[np.ndarray, "cluster local local"]
    weights: Float[np.ndarray, " cluster"]
    bend: Float[np.ndarray, " dimension"]

    @property
    def finite(self) -> bool:
        """Whether a step can be told: far out a curvature may overflow where the log posterior does not."""
        return all((np.abs(part) < _ENDLESS).all() for part in vars(self).values())

    def eliminated(self) -> tuple[np.ndarray, np.ndarray]:
        """Curvature (cluster, local, local) of the local coordinates, and (global, global) of the others without them."""
        local, schur = positive(self.local), self.curvature
        if local.shape[-1]:
            answer = np.linalg.solve(local, np.swapaxes(self.cross, 1, 2))
            schur = schur - np.einsum("c,cij,cjk->ik", self.weights, self.cross, answer)
        return local, positive(schur) if np.isfinite(schur).all() else schur

    @property
    def own(self) -> System:
        """The system of the local coordinates alone, the global ones held."""
        return replace(
            self, gradient=self.gradient[:0], curvature=self.curvature[:0, :0], cross=self.cross[:, :0]
        )


class NewtonStep(NamedTuple):
    """How far to move, and the gain in log posterior that a quadratic promises."""

    shared: Float[np.ndarray, " global"]
    local: Float[np.ndarray, "cluster local"]
    gain: float


def positive(matrix: np.ndarray) -> np.ndarray:
    """Nearest curvature with eigenvalues bounded away from zero, for symmetric matrices (..., n, n) of any units."""
    if matrix.shape[-1] == 0:
        return matrix
    symmetric = (matrix + np.swapaxes(matrix, -1, -2)) / 2
    size = np.sqrt(np.maximum(np.abs(np.einsum("...ii->...i", symmetric)), 1e-300))
    outer = size[..., :, None] * size[..., None, :]
    scaled = symmetric / outer
    if _is_positive(scaled):
        return symmetric
    values, vectors = np.linalg.eigh(scaled)
    values = np.abs(values)
    values = np.maximum(values, 1e-12 * np.maximum(values.max(axis=-1, keepdims=True), 1.0))
    return np.einsum("...ij,...j,...kj->...ik", vectors, values, vectors) * outer


def _is_positive(scaled: np.ndarray) -> bool:
    """Whether matrices of unit diagonal are safely positive, found at a tenth of the cost of their eigenvalues."""
    try:
        factor = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return False
    return bool(np.einsum("...ii->...i", factor).min() > _SAFE)


def local_step(system: System, damping: Float[np.ndarray, " cluster"]) -> NewtonStep:
    """The step of the local coordinates, the global ones held; each cluster has a damping of its own."""
    _, alone = _alone(system, damping)
    gain = float((system.weights[:, None] * system.local_gradient * alone).sum()) / 2
    return NewtonStep(np.zeros(len(system.gradient)), alone, gain)


def newton_step(system: System, damping: float, lowest: Float[np.ndarray, " global"]) -> NewtonStep:
    """The step of all coordinates; a global one that would leave its range stops at the edge and the others adapt.

    Args:
        system: the normal equations.
        damping: added to the curvatures, as a share of their diagonal.
        lowest: the smallest step that each global coordinate may make.
    """
    if not len(system.gradient):
        return local_step(system, np.full(len(system.weights), damping))
    local, alone = _alone(system, np.full(len(system.weights), damping))
    weights, schur, gradient = system.weights, system.curvature, system.gradient
    answer = np.zeros((len(weights), local.shape[-1], len(gradient)))
    if local.shape[-1]:
        answer = np.linalg.solve(local, np.swapaxes(system.cross, 1, 2))
        schur = schur - np.einsum("c,cij,cjk->ik", weights, system.cross, answer)
        gradient = gradient - np.einsum("c,cij,cj->i", weights, system.cross, alone)
    schur = positive(schur) + damping * np.diag(np.maximum(np.diag(schur), 1e-12))
    shared = _bounded(schur, gradient, lowest)
    moved = alone - np.einsum("cij,j->ci", answer, shared)
    own = (weights[:, None] * system.local_gradient * moved).sum()
    return NewtonStep(shared, moved, float(system.gradient @ shared + own) / 2)


def _alone(system: System, damping: Float[np.ndarray, " cluster"]) -> tuple[np.ndarray, np.ndarray]:
    """Damped curvature of the local coordinates, and their step with the global ones held."""
    local = positive(system.local)
    if not local.shape[-1]:
        return local, system.local_gradient
    diagonal = np.einsum("cii->ci", local)[:, :, None] * np.eye(local.shape[-1])
    local = local + damping[:, None, None] * diagonal
    return local, np.linalg.solve(local, system.local_gradient[..., None])[..., 0]


def _bounded(curvature: np.ndarray, gradient: np.ndarray, lowest: np.ndarray) -> np.ndarray:
    """Maximiser of a quadratic whose coordinates are at least `lowest`, by putting those below on their edge."""
    edge = np.zeros(len(gradient), bool)
    step = np.zeros(len(gradient))
    for _ in range(_EDGES):
        step = np.where(edge, lowest, 0.0)
        free = ~edge
        if free.any():
            rest = gradient[free] - curvature[np.ix_(free, edge)] @ step[edge]
            inner = curvature[np.ix_(free, free)]
            size = np.sqrt(np.maximum(np.diag(inner), 1e-300))
            step[free] = linalg.solve(inner / np.outer(size, size), rest / size, assume_a="pos") / size
        outside = free & (step < lowest)
        if not outside.any():
            break
        edge |= outside
    return np.maximum(step, lowest)
