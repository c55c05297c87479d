"""Scores whose part that goes with clusters' own unknowns is taken at the centre of their prior.

That part has a coefficient which depends on own unknowns where these act through a curved function, or where an effect
multiplies what they move. At the fit, the score is then made of their squares, and these vary from data set to data set; in
data sets drawn at the fit own unknowns stay where they are. At the centre it is linear in them.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from dtprob.gap.fitting.columns import rows_of_each, scores_of_each

_FAINT: Final = 1e-6
"""Share of the largest curvature, each unknown in units of its own, below which what moves together moves nothing."""
MOST: Final = 1024
"""Own unknowns of a cluster up to which scores are centred."""


class Centred(NamedTuple):
    """With W the tangents (row, own) of a cluster's own unknowns, what W (W' W)^-1 is at the fit and at the centre.

    Of states that clusters share there is one W, with the rows of all clusters.

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

    @classmethod
    def of(cls, x: np.ndarray, own: np.ndarray, there: np.ndarray) -> Centred:
        """From the centre, and tangents (cluster, row, own) of clusters' own unknowns at the fit and there."""
        return cls(x, own, per_unit(own), per_unit(there))

    @property
    def amplified(self) -> float:
        """How many times larger rows with the same scores are at the centre than at the fit."""
        return float(np.linalg.norm(self.there) / np.linalg.norm(self.here))

    def without_own(self, rows: np.ndarray) -> np.ndarray:
        """Rows (n, cluster, row) less what own unknowns could make of them."""
        each = self._each(rows)
        return (each - rows_of_each(self.here, scores_of_each(self.own, each))).reshape(rows.shape)

    def split(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (n, cluster, row) whose slopes are to be taken at the fit, and those at the centre."""
        each = self._each(rows)
        found = scores_of_each(self.own, each)
        parts = each - rows_of_each(self.here, found), rows_of_each(self.there, found)
        return parts[0].reshape(rows.shape), parts[1].reshape(rows.shape)

    def columns(self, here: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Tangents (cluster, row, k) of effects from those at the fit and those at the centre."""
        shape = (*self.own.shape[:2], here.shape[-1])
        own = np.swapaxes(self.here, 1, 2) @ here.reshape(shape)
        centre = np.swapaxes(self.there, 1, 2) @ there.reshape(shape)
        return here + (self.own @ (centre - own)).reshape(here.shape)

    def _each(self, rows: np.ndarray) -> np.ndarray:
        """Rows (n, cluster, row) as those of each W."""
        return rows.reshape(len(rows), *self.own.shape[:2])


def per_unit(own: np.ndarray) -> np.ndarray:
    """W (W' W)^-1 of tangents W (cluster, row, own), whatever their units; what moves nothing is left out."""
    size = np.sqrt((own**2).sum(axis=1, keepdims=True))
    size = np.where(size > 0, size, 1.0)
    unit = own / size
    return unit @ np.linalg.pinv(np.swapaxes(unit, 1, 2) @ unit, rcond=_FAINT, hermitian=True) / size
