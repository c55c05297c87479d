"""Scores whose part that goes with clusters' own unknowns is taken at the centre of their prior.

That part has a coefficient which depends on own unknowns where these act through a curved function, or where an effect
multiplies what they move. At the fit, the score is then made of their squares, and these vary from data set to data set; in
data sets drawn at the fit own unknowns stay where they are. At the centre it is linear in them.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting.active import Active, basis
from dtprob.gap.model.problem import Problem

_MOST: Final = 8
"""Own unknowns of a cluster up to which scores are centred."""


class Centred(NamedTuple):
    """With W the tangents (row, own) of a cluster's own unknowns, what W (W' W)^-1 is at the fit and at the centre.

    Attributes:
        x: the flat vector of the fit, own unknowns at the centre of their prior.
        own: W at the fit (cluster, row, own).
        here: W (W' W)^-1 there.
        there: the same at the centre.
    """

    x: Float[np.ndarray, " dimension"]
    own: Float[np.ndarray, "cluster row own"]
    here: Float[np.ndarray, "cluster row own"]
    there: Float[np.ndarray, "cluster row own"]

    def split(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (n, cluster, row) whose slopes are to be taken at the fit, and those at the centre."""
        scores = np.einsum("ncr,crl->ncl", rows, self.own, optimize=True)
        here, there = (
            np.einsum("crl,ncl->ncr", part, scores, optimize=True) for part in (self.here, self.there)
        )
        return rows - here, there

    def columns(self, here: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Tangents (cluster, row, k) of effects from those at the fit and those at the centre."""
        own, centre = np.swapaxes(self.here, 1, 2) @ here, np.swapaxes(self.there, 1, 2) @ there
        return here + self.own @ (centre - own)


def centred(
    problem: Problem,
    active: Active,
    x: Float[np.ndarray, " dimension"],
    own: Float[np.ndarray, "cluster row own"],
    deviation: Float[np.ndarray, "cluster own"],
) -> Centred | None:
    """How scores at a fit are centred; None where own unknowns are many, or the model is not finite at the centre.

    Many are states of a series, on which sites mostly depend in a straight line.

    Args:
        problem: the model on its data.
        active: what the fit moves.
        x: the fit.
        own: tangents of clusters' own unknowns there.
        deviation: of these from the centre of their prior.
    """
    if own.shape[2] > _MOST:
        return None
    centre = x.copy()
    centre[active.local_index] -= deviation
    there = np.asarray(problem.compiled.linearised(centre, own_basis(problem, active))[1])
    found = Centred(centre, own, per_unit(own), per_unit(there))
    return found if np.isfinite(found.there).all() else None


def own_basis(problem: Problem, active: Active) -> Float[np.ndarray, "own dimension"]:
    """One direction per own unknown that moves it in all clusters at once."""
    return basis(problem, active)[len(active.global_index) :]


def per_unit(own: np.ndarray) -> np.ndarray:
    """W (W' W)^-1 of tangents W (cluster, row, own); what moves nothing is left out."""
    return own @ np.linalg.pinv(np.swapaxes(own, 1, 2) @ own, hermitian=True)
