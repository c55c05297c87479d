"""Whitened rows of all observations, sorted by cluster."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.errors import InputError
from dtprob.models.arguments import Data
from dtprob.models.declaration import Declaration, Site


@dataclass(frozen=True)
class Rows:
    """Where each whitened row belongs.

    Attributes:
        ids: cluster of every row.
        coordinates: position of every row along each named axis, -1 where it has none.
        located: 1 for rows that stand for a location or probability, 0 for a spread.
        gather: (cluster, row) positions of each cluster's rows; the position after the last stands for padding.
        cluster_name: the axis or column of the clusters.
        shapes: (component, *site) of each observed site's rows.
    """

    ids: np.ndarray
    coordinates: Mapping[str, np.ndarray]
    located: np.ndarray
    gather: np.ndarray
    cluster_name: str
    shapes: Mapping[str, tuple[int, ...]]

    @cached_property
    def is_location(self) -> np.ndarray:
        """Which rows (cluster, row) stand for a location or probability; padding does not."""
        return self.by_cluster(self.located) == 1

    @cached_property
    def is_spread(self) -> np.ndarray:
        """Which rows (cluster, row) stand for a spread; padding does not."""
        return self.by_cluster(self.located) == 0

    @property
    def n_cluster(self) -> int:
        """Number of clusters."""
        return int(self.gather.shape[0])

    def stack(self, rows: Mapping[str, jax.Array]) -> jax.Array:
        """Rows of all observed sites, (component, *site) each, as (cluster, row), padded with zeros.

        The sites come in the model's order, whatever the mapping's: what has been through `jax.jit` is in that of names.
        """
        return stacked([rows[name] for name in self.shapes], self.gather)

    def unstack(self, rows: np.ndarray) -> np.ndarray:
        """Rows (..., cluster, row) as (..., flat), as they lie in the observed sites one after another."""
        flat = np.zeros((*rows.shape[:-2], len(self.ids) + 1), rows.dtype)
        flat[..., self.gather] = rows
        return flat[..., :-1]

    @property
    def components(self) -> dict[str, int]:
        """Rows per entry of each observed site."""
        return {name: shape[0] for name, shape in self.shapes.items()}

    def by_site(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Rows (..., component, *site) of each observed site, from those of all (..., cluster, row)."""
        flat, start, found = self.unstack(rows), 0, dict[str, np.ndarray]()
        for name, shape in self.shapes.items():
            stop = start + math.prod(shape)
            found[name] = flat[..., start:stop].reshape(*flat.shape[:-1], *shape)
            start = stop
        return found

    def of_entries(self, entries: Mapping[str, np.ndarray]) -> np.ndarray:
        """Entries of each observed site (*site) as rows (cluster, row), the same in each of their rows."""
        whole = {n: np.broadcast_to(entries[n], shape) for n, shape in self.shapes.items()}
        return np.concatenate([*(value.reshape(-1) for value in whole.values()), [0]])[self.gather]

    def by_cluster(self, values: np.ndarray) -> np.ndarray:
        """A flat per-row array as (cluster, row), padded with -1."""
        return np.concatenate([values, [-1]])[self.gather]


def stacked(rows: Iterable[jax.Array], gather: Any) -> jax.Array:
    """Rows of observed sites one after another by cluster: entries at positions (cluster, row), a zero behind the last."""
    return jnp.concatenate([*(value.reshape(-1) for value in rows), jnp.zeros(1)])[gather]


def make_rows(
    declaration: Declaration,
    shapes: Mapping[str, tuple[int, ...]],
    located: Mapping[str, int],
    data: Data,
    column: str | None,
    *,
    joint: Collection[str] = (),
) -> Rows:
    """Index the rows of every observed site.

    Args:
        declaration: the model's sites.
        shapes: (component, *site shape) of each observed site's rows.
        located: how many components of each stand for its location.
        data: holds the cluster column, if one is named.
        column: a data entry whose values name the clusters; None for the declaration's axis.
        joint: the sites whose entries along their last axis are one vector.

    Raises:
        InputError: a site has no axis of clusters, or a vector would be torn apart.
    """
    axes = sorted({axis for name in shapes for axis in declaration.sites[name].axes})
    coordinates: dict[str, list[np.ndarray]] = {axis: [] for axis in axes}
    ids, marks = [], []
    labels = None if column is None else _labels(np.asarray(data[column]))
    for name, shape in shapes.items():
        site, grid = declaration.sites[name], np.indices(shape)
        for axis in axes:
            index = grid[1 + site.axes.index(axis)] if axis in site.axes else np.full(shape, -1)
            coordinates[axis].append(index.reshape(-1))
        own = _cluster_of(declaration, site, grid[1:], labels, column)
        if name in joint and (own != own[..., :1]).any():
            raise InputError(
                "cluster",
                f"whole vectors of {name!r} in each",
                f"{column or declaration.cluster or 'its own axis'!r}, which runs along a vector",
                "Observe several vectors, in a plate, and name its axis",
            )
        ids.append(own.reshape(-1))
        marks.append((grid[0] < located[name]).reshape(-1))
    found = np.concatenate(ids)
    name = column or declaration.cluster or "row"
    joined = {axis: np.concatenate(parts) for axis, parts in coordinates.items()}
    marked = np.concatenate(marks).astype(int)
    return Rows(found, joined, marked, _gather_index(found), name, dict(shapes))


def _labels(column: np.ndarray) -> np.ndarray:
    """A cluster number for each entry; their own order if all differ, so that local coordinates keep theirs."""
    names, labels = np.unique(column, return_inverse=True)
    return np.arange(len(column)) if len(names) == len(column) else labels


def _cluster_of(
    declaration: Declaration, site: Site, grid: np.ndarray, labels: np.ndarray | None, column: str | None
) -> np.ndarray:
    if labels is not None:
        matching = [i for i, n in enumerate(site.shape) if n == len(labels)]
        if len(matching) > 1:
            raise InputError(
                "cluster",
                f"a column as long as one axis of {site.name!r}",
                f"{column!r}, as long as {' and '.join(site.axes[i] for i in matching)}",
                "Name one of these axes, or give the column another length",
            )
        if matching:
            return labels[grid[matching[0]]]
    elif declaration.cluster in site.axes:
        return grid[site.axes.index(str(declaration.cluster))]
    elif declaration.cluster is None and site.shape:
        return grid[0]
    raise InputError(
        "cluster",
        f"an axis of {site.name!r} ({', '.join(site.axes)}) or a column as long as one",
        repr(column or declaration.cluster),
        "Name the axis or column whose values are independent of one another",
    )


def _gather_index(ids: np.ndarray) -> np.ndarray:
    order, counts = np.argsort(ids, kind="stable"), np.bincount(ids)
    index = np.full((len(counts), int(counts.max())), len(ids))
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    for c, (start, count) in enumerate(zip(starts, counts, strict=True)):
        index[c, :count] = order[start : start + count]
    return index
