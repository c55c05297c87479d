"""Which way the data stray from the twin, in their own unit: the mean difference in groups along each column of the data.

What the twin's fitted parameters take up is no difference: it is taken off the data and off data drawn at the fit alike, to
first order. The spread of a mean is that of the drawn data.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import sparse, stats

from dtprob.gap.fitting.bootstrap import Replicates
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation import whiten
from dtprob.gap.where.data_columns import columns, whole_columns
from dtprob.models.declaration import Site

_FEWEST: Final = 4
_MOST: Final = 24
"""Groups of a column."""
_EACH: Final = 10
"""Positions of a group at least, where there are enough for the fewest groups."""
_NOTHING: Final = 1e-6
"""Spread of a mean, in that of one value, below which the fit has taken up all of it."""
_DECIBELS: Final = 10.0 / math.log(10.0)


@dataclass(frozen=True)
class Differences:
    """Data less twin along a column.

    Attributes:
        observed: the observed site.
        axis: of the site, along which the column lies; "" where it has an entry for each observation.
        column: of the data.
        unit: "dB" of log-normal observations, else "", the unit of the data.
        place: median of the column in each group.
        mean: difference in each group, weighted by how well each value is known.
        spread: standard deviation of that where the twin is right.
    """

    observed: str
    axis: str
    column: str
    unit: str
    place: Float[np.ndarray, " group"]
    mean: Float[np.ndarray, " group"]
    spread: Float[np.ndarray, " group"]

    @property
    def largest(self) -> float:
        """The largest difference, in its standard deviations."""
        return float(np.max(np.abs(self.mean) / self.spread, initial=0.0))


class _Strays(NamedTuple):
    """Weighted rows (1 + replicate, position) of an observed site along an axis, or of each entry; weights (position,)."""

    observed: str
    axis: str
    unit: str
    rows: np.ndarray
    known: np.ndarray

    def over(self, found: Mapping[str, np.ndarray]) -> list[Differences]:
        """The differences along columns that tell something."""
        return [self._along(name, values.reshape(-1)) for name, values in found.items() if _is_told(values)]

    def _along(self, column: str, values: np.ndarray) -> Differences:
        """The differences in groups of a column (position,), without those where nothing is seen or the fit takes all."""
        group = _groups(values)
        member = sparse.csr_matrix((np.ones(len(group)), (group, np.arange(len(group)))))
        weight = member @ self.known
        mean = (member @ self.rows.T).T / np.where(weight > 0, weight, np.inf)
        spread = mean[1:].std(axis=0)
        told = spread * np.sqrt(weight) > _NOTHING
        place = np.array([np.median(values[group == g]) for g in range(len(weight))])
        return Differences(
            self.observed, self.axis, column, self.unit, place[told], mean[0, told], spread[told]
        )


def differences(problem: Problem, drawn: Replicates) -> tuple[Differences, ...]:
    """Of real observations with a location, along columns of the data and what is computed from them alone.

    Those that stand out most come first.
    """
    around = problem.compiled.observations(drawn.fitted.x)
    weights = {name: _rows_per_unit(one) for name, one in around.items()}
    if all(weight is None for weight in weights.values()):
        return ()
    found: list[Differences] = []
    for name, rows in problem.rows.by_site(drawn.rows).items():
        site, weight = problem.declaration.observed[name], weights[name]
        if weight is None:
            continue
        unit, weighted, known = (
            "dB" if around[name].family == "LogNormal" else "",
            rows[:, 0] * weight,
            weight**2,
        )
        whole = _Strays(name, "", unit, weighted.reshape(len(weighted), -1), known.reshape(-1))
        found += whole.over(_of_each(problem, drawn.fitted.x, site))
        for i, axis in enumerate(site.axes):
            rest = tuple(j for j in range(len(site.shape)) if j != i)
            summed = weighted.sum(axis=tuple(j + 1 for j in rest)), known.sum(axis=rest)
            found += _Strays(name, axis, unit, *summed).over(columns(problem, axis, site.shape[i]))
    return tuple(sorted((d for d in found if len(d.place) > 1), key=lambda d: -d.largest))


def _rows_per_unit(observed: whiten.Observation) -> np.ndarray | None:
    """By how much the first row of each value moves with its mean; None where it is no distance from it."""
    if observed.family not in {"Normal", "LogNormal"}:
        return None  # rows of others are scores, which do not grow with the distance
    still = {name: jnp.zeros_like(value) for name, value in observed.parameters.items()}
    moved = np.asarray(whiten.shift(observed, still | {"loc": jnp.ones_like(observed.parameters["loc"])})[0])
    return moved / _DECIBELS if observed.family == "LogNormal" else moved


def _of_each(problem: Problem, x: np.ndarray, site: Site) -> dict[str, np.ndarray]:
    """What has an entry for each observation: data, and what the model computes from them alone, as a distance."""
    here, there = problem.compiled.sites(x), problem.compiled.sites(problem.null())
    found = {
        n: np.asarray(here[n]) for n in problem.float_sites if n in here and np.array_equal(here[n], there[n])
    }
    found |= whole_columns(problem, site)
    return {n: v for n, v in found.items() if v.shape == site.shape and not np.iscomplexobj(v)}


def _is_told(values: np.ndarray) -> bool:
    """Whether groups of a column tell something: finite numbers."""
    return (np.issubdtype(values.dtype, np.number) or values.dtype == bool) and bool(
        np.isfinite(values).all()
    )


def _groups(values: np.ndarray) -> Int[np.ndarray, " position"]:
    """A group of each position: one for each value where there are few, else as many as hold enough; ties stay together."""
    distinct, index = np.unique(values, return_inverse=True)
    if len(distinct) <= _MOST:
        return index
    count = int(np.clip(len(values) // _EACH, _FEWEST, _MOST))
    rank = stats.rankdata(values, method="min").astype(int) - 1
    return np.unique(rank * count // len(values), return_inverse=True)[1]
