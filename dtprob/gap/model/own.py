"""Which unknowns of a model have an entry for each cluster, so that a fit can find and integrate them cluster by cluster.

Where an axis of the model makes the clusters, entries along any axis of that size may be, in that order; where a column of
the data does, as in `level[site]` with clusters by `site`, in the order of rows or by number. The model is asked: an entry
belongs to a cluster if nothing else depends on it, which is not so of independent draws made into a Gaussian process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from dtprob.gap.model.quick import quick_jit
from dtprob.models.declaration import Declaration

if TYPE_CHECKING:
    from dtprob.gap.model.layout import Block
    from dtprob.gap.model.problem import Problem

_SPLITS: Final = 8
"""Halves of the clusters whose entries are moved: two clusters lie in one half of all with probability 2^-8."""
_EXACT: Final = 1e3
"""Change of a log density that is rounding, in the precision of its numbers."""

type LogDensities = Callable[[np.ndarray], tuple[np.ndarray, float]]
"""Flat vector -> log likelihood of each cluster, log prior of all that is shared."""


class Own(NamedTuple):
    """Along which axis of an unknown the clusters lie, and at which of its positions each one."""

    axis: int
    position: Int[np.ndarray, " cluster"]

    def arranged(self, index: Int[np.ndarray, "*shape"]) -> Int[np.ndarray, "cluster size"]:
        """Entries in the shape of the unknown, cluster by cluster."""
        first = np.moveaxis(index, self.axis, 0)[self.position]
        return first.reshape(len(self.position), -1)

    def summed(self, density: jax.Array) -> jax.Array:
        """Log density (*site) summed to (cluster,)."""
        first = jnp.moveaxis(density, self.axis, 0)[self.position]
        return first.reshape(len(self.position), -1).sum(1)


def of_latents(problem: Problem) -> dict[str, Own]:
    """Which latent sites have entries for each cluster, asked of a problem in which none counts as having any."""
    blocks = problem.blocks_of(None)
    if problem.column is not None:
        return _moved_along_column(problem, blocks)
    count = problem.n_cluster
    wide = {b.name: b.index.reshape(b.shape) for b in blocks if count in b.shape}
    if not wide:
        return {}
    told, x = _densities(problem), problem.prior_draws(jax.random.key(0), 1)[0]
    likelihood, prior = told(x)
    if not np.isfinite([*likelihood, prior]).all():
        return along_axis(problem.declaration, {b.name: b.shape for b in blocks}, count)
    return _asked(wide, count, [np.arange(count)], x, told)


def of_fields(problem: Problem) -> dict[str, Own]:
    """The same of the fields of variance effects, where a column makes the clusters."""
    found: dict[str, Own] = {}
    for name in problem.field_shapes:
        with_it = problem.with_live([name])
        found |= _moved_along_column(with_it, [with_it.field_of(with_it.live[0])])
    return found


def _moved_along_column(problem: Problem, blocks: Iterable[Block]) -> dict[str, Own]:
    wide = {b.name: b.index.reshape(b.shape) for b in blocks if problem.n_cluster in b.shape}
    if not wide:
        return {}
    told = _densities(problem)
    column = np.asarray(problem.data[str(problem.column)])
    return along_column(wide, column, problem.prior_draws(jax.random.key(0), 1)[0], told)


def _densities(problem: Problem) -> LogDensities:
    terms, arrays = quick_jit(problem.compiled.terms), problem.compiled.arrays

    def told(x: np.ndarray) -> tuple[np.ndarray, float]:
        found = terms(x, arrays)
        return np.asarray(found.likelihood), float(found.prior)

    return told


def along_axis(
    declaration: Declaration, shapes: Mapping[str, tuple[int, ...]], n_cluster: int
) -> dict[str, Own]:
    """Unknowns in the plate of the clusters, by the unconstrained shape of each."""
    inside = {n: site for n, site in declaration.latent.items() if declaration.cluster in site.plates}
    axes = {n: site.axes for n, site in inside.items() if len(site.axes) == len(shapes[n])}
    found = {n: names.index(declaration.cluster) for n, names in axes.items() if declaration.cluster in names}
    return {n: Own(i, np.arange(n_cluster)) for n, i in found.items() if shapes[n][i] == n_cluster}


def along_column(
    unknowns: Mapping[str, Int[np.ndarray, "*shape"]],
    column: np.ndarray,
    x: Float[np.ndarray, " dimension"],
    told: LogDensities,
) -> dict[str, Own]:
    """Unknowns each of whose entries acts in one cluster: in that of its number in a column, or in the order of rows.

    Args:
        unknowns: positions in the flat vector, in the shape of each.
        column: whose values make the clusters.
        x: a point with finite densities.
        told: the model's densities.
    """
    distinct = np.unique(column)
    count = len(distinct)
    values = column if count == len(column) else distinct
    orders = [np.arange(count)]
    if np.issubdtype(values.dtype, np.number) and np.array_equal(np.sort(values), np.arange(count)):
        orders.insert(0, values.astype(int))
    return _asked(unknowns, count, orders, x, told)


def _asked(
    unknowns: Mapping[str, Int[np.ndarray, "*shape"]],
    count: int,
    orders: Iterable[Int[np.ndarray, " cluster"]],
    x: Float[np.ndarray, " dimension"],
    told: LogDensities,
) -> dict[str, Own]:
    """Those of the unknowns whose entries along an axis of that many belong to the clusters in one of some orders."""
    found: dict[str, Own] = {}
    for name, index in unknowns.items():
        axes = [i for i, n in enumerate(index.shape) if n == count]
        tries = (Own(axis, order) for axis in axes for order in orders)
        own = next((one for one in tries if _belong(one.arranged(index), x, told)), None)
        if own is not None:
            found[name] = own
    return found


def _belong(index: Int[np.ndarray, "cluster size"], x: np.ndarray, told: LogDensities) -> bool:
    """Whether moving the entries of some clusters leaves the others' likelihood alone, and the prior falls apart."""
    rng = np.random.default_rng(0)
    step = 0.1 * rng.standard_normal(index.shape)
    before, prior = told(x)
    rounding = _EXACT * np.finfo(before.dtype).eps
    both = told(_moved(x, index, step, np.ones(len(index), bool)))[1]
    moves_any = False
    for moved in _halves(len(index), rng):
        likelihood, priors = zip(
            *(told(_moved(x, index, step, part)) for part in (moved, ~moved)), strict=True
        )
        change = np.abs(np.where(moved, likelihood[1], likelihood[0]) - before)
        apart = abs(priors[0] + priors[1] - both - prior)
        alone = bool((change <= rounding * np.maximum(np.abs(before), 1.0)).all())
        if not alone or not apart <= rounding * max(abs(prior), 1.0):
            return False
        moves_any |= bool((np.where(moved, likelihood[0], likelihood[1]) != before).any())
    return moves_any


def _halves(count: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    for _ in range(_SPLITS):
        yield rng.permutation(np.arange(count) < count // 2)


def _moved(x: np.ndarray, index: np.ndarray, step: np.ndarray, part: np.ndarray) -> np.ndarray:
    x = x.copy()
    x[index[part]] += step[part]
    return x
