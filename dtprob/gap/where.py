"""Where the gap lies: over the model's sites and over the data's coordinates, each map with family-wise control.

Site families are made from the model's own trace: each deterministic site, perturbed additively or in proportion,
independently per entry, pooled along axes, smooth along an axis or along a column of the data. One gradient per bootstrap
replicate serves all of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.gap.bootstrap import Replicates
from dtprob.gap.curves import curves
from dtprob.gap.fit import Fit
from dtprob.gap.problem import Problem
from dtprob.gap.projection import Projection
from dtprob.gap.tails import family_wise, gamma_tail

_CHANCE = 8
"""Replicates that tell what a site would gain by chance."""


@dataclass(frozen=True)
class SiteFinding:
    """Evidence that a site's values are wrong.

    Attributes:
        site: its name.
        family: "additive" or "relative", and the axes along which the perturbation varies.
        p_value: family-wise over all sites and families.
        gain: nats that moving the site along its steepest direction would gain, nuisances refitted to first order.
    """

    site: str
    family: str
    p_value: float
    gain: float


@dataclass(frozen=True)
class CoordinateFinding:
    """A block of coordinates that holds more misfit than the model allows.

    Attributes:
        axis: the data axis.
        low, high: first and last position of the block.
        p_value: family-wise over all blocks of all axes.
        excess: whitened energy above its expectation, in nats.
    """

    axis: str
    low: int
    high: int
    p_value: float
    excess: float


@dataclass(frozen=True)
class Location:
    """Maps of the gap at one fit."""

    sites: tuple[SiteFinding, ...]
    coordinates: tuple[CoordinateFinding, ...]
    axes: dict[str, np.ndarray]
    site_p_value: float


def locate(problem: Problem, fitted: Fit, projection: Projection, drawn: Replicates) -> Location:
    """Test every site family and every block of coordinates at a fit."""
    at = problem.compiled.sites(projection.origin)  # what was fitted to these data would agree with them
    values = {n: np.asarray(v) for n, v in at.items() if n in drawn.gradients}
    tested = {name: _family_test(score) for name, score in _scores(problem, drawn.gradients, values)}
    p = np.array([family.p_value for family in tested.values()])
    null = [family.null for family in tested.values()]
    adjusted = family_wise(p, np.stack(null, axis=1).min(axis=1)) if null else np.ones(0)
    by_name = dict(zip(tested, adjusted, strict=True))
    findings = _best_per_site(
        problem, fitted, projection, drawn, adjusted=by_name, tested=tested, values=values
    )
    blocks, maps = _coordinates(problem, np.asarray(drawn.observed), np.asarray(drawn.projected))
    return Location(findings, blocks, maps, float(adjusted.min(initial=1.0)))


class _Family(NamedTuple):
    """A site family's test.

    Attributes:
        p_value: of the data.
        null: p-value of each replicate.
        first: scores (1 + _CHANCE, entry) of the data and of the first replicates.
        variance: of the scores, (entry,).
    """

    p_value: float
    null: np.ndarray
    first: np.ndarray
    variance: np.ndarray


def _scores(
    problem: Problem, gradients: Mapping[str, jax.Array], values: Mapping[str, np.ndarray]
) -> Iterator[tuple[tuple[str, str], np.ndarray]]:
    """(site, family) and scores (1 + replicate, entry) of every site family, one after another."""
    for site, gradient in gradients.items():
        g, axes = np.asarray(gradient), problem.declaration.sites[site].axes
        for kind, entry in (("additive", g), ("relative", g * values[site])):
            parts = (
                np.stack([np.real(entry), np.imag(entry)], -1) if np.iscomplexobj(entry) else entry[..., None]
            )
            shape = entry.shape[1:]
            for kept in _kept_axes(shape):
                summed = parts.sum(axis=tuple(1 + i for i in range(len(shape)) if i not in kept))
                label = f"{kind}, " + (" x ".join(axes[i] for i in kept) if kept else "common")
                yield (site, label), summed.reshape(len(g), -1)
            for i, axis in enumerate(axes):
                for name, curve in curves(problem, axis, shape[i]).items():
                    along = parts.sum(axis=tuple(1 + j for j in range(len(shape)) if j != i))
                    yield (site, f"{kind}, {name}"), (curve @ along).reshape(len(g), -1)


def _kept_axes(shape: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Axes along which a perturbation varies: none, one, all but one, all."""
    wide = [i for i, n in enumerate(shape) if n > 1]
    sizes = sorted({0, 1, len(wide) - 1, len(wide)} & set(range(len(wide) + 1)))
    for size in sizes:
        yield from itertools.combinations(wide, size)


def _family_test(scores: np.ndarray) -> _Family:
    """Test a family's summed squared scores (1 + replicate, entry), each entry scaled by its null variance."""
    first, n = scores[: 1 + _CHANCE].copy(), len(scores) - 1
    observed, null = scores[0], scores[1:]
    total = (null**2).sum(0)
    variance = total / n
    alive = total > 1e-12 * max(float(total.max(initial=0.0)), 1e-300)
    if not alive.any():
        return _Family(1.0, np.ones(n), first, variance)
    null, observed, total = null[:, alive], observed[alive], total[alive]
    left_out = (total - null**2) / (n - 1)
    known = left_out > 1e-9 * total / n  # rare outcomes move an entry in one replicate and in no other
    statistic = (np.where(known, null**2, 0.0) / np.where(known, left_out, 1.0)).sum(1)
    value = float((observed**2 / (total / n)).sum())
    mean, spread = statistic.mean(), statistic.var()
    p_null, _ = gamma_tail(statistic, np.asarray(mean), np.asarray(spread))
    p, _ = gamma_tail(np.asarray([value]), np.asarray(mean), np.asarray(spread))
    return _Family(float(p[0]), p_null, first, variance)


def _best_per_site(
    problem: Problem,
    fitted: Fit,
    projection: Projection,
    drawn: Replicates,
    *,
    adjusted: Mapping[tuple[str, str], float],
    tested: Mapping[tuple[str, str], _Family],
    values: Mapping[str, np.ndarray],
) -> tuple[SiteFinding, ...]:
    """For each site the family with the smallest p-value, with the gain along its steepest direction."""
    findings = []
    for site, value in values.items():
        best = min(
            (n for n in adjusted if n[0] == site),
            key=lambda n: (adjusted[n], -float((tested[n].first[0] ** 2).sum())),
        )
        shape = drawn.gradients[site].shape[1:]
        grown = np.broadcast_to(value, shape)
        family = tested[best]
        steps = [_direction(problem, best, score, family.variance, grown) for score in family.first]
        shifts = projection.rows(
            jnp.moveaxis(problem.compiled.site_shift(fitted.x, {site: np.stack(steps)}), -1, 0)
        )
        rows = jnp.concatenate([drawn.observed[None], drawn.projected[:_CHANCE]])
        slope = np.asarray(jnp.einsum("ncm,ncm->n", shifts, rows))
        curvature = np.asarray(jnp.einsum("ncm,ncm->n", shifts, shifts))
        gain = np.where(curvature > 0, 0.5 * slope**2 / np.maximum(curvature, 1e-300), 0.0)
        net = max(float(gain[0] - gain[1:].mean()), 0.0)
        findings.append(SiteFinding(site, best[1], float(adjusted[best]), net))
    return tuple(sorted(findings, key=lambda f: (f.p_value, -f.gain)))


def _direction(
    problem: Problem, name: tuple[str, str], score: np.ndarray, variance: np.ndarray, value: np.ndarray
) -> np.ndarray:
    """The site perturbation that a family's scores point to, of the site's shape and dtype."""
    site, family = name
    axes = problem.declaration.sites[site].axes
    relative = family.startswith("relative")
    label = family.split(", ", 1)[1]
    for i, axis in enumerate(axes):
        curve = curves(problem, axis, value.shape[i]).get(label)
        if curve is not None:
            step = _along(score, variance, value, curve)
            shape = [n if j == i else 1 for j, n in enumerate(value.shape)]
            return np.broadcast_to(step.reshape(shape), value.shape) * (value if relative else 1.0)
    kept = [] if label == "common" else label.split(" x ")
    floor = 1e-12 * max(float(variance.max(initial=0.0)), 1e-300)
    step = np.where(variance > floor, score / np.where(variance > floor, variance, 1.0), 0.0)
    shape = [n if axes[i] in kept and n > 1 else 1 for i, n in enumerate(value.shape)]
    if np.iscomplexobj(value):
        pair = step.reshape(*shape, 2)
        step_array = pair[..., 0] - 1j * pair[..., 1]
    else:
        step_array = step.reshape(shape)
    return np.broadcast_to(step_array, value.shape) * (value if relative else 1.0)


def _along(score: np.ndarray, variance: np.ndarray, value: np.ndarray, curves: np.ndarray) -> np.ndarray:
    """Step along one axis that the scores of curves on it point to."""
    weight = score / np.maximum(variance, 1e-12 * max(float(variance.max(initial=0.0)), 1e-300))
    if np.iscomplexobj(value):
        pair = weight.reshape(len(curves), 2)
        return curves.T @ (pair[:, 0] - 1j * pair[:, 1])
    return curves.T @ weight


def _coordinates(
    problem: Problem, observed: np.ndarray, null: np.ndarray
) -> tuple[tuple[CoordinateFinding, ...], dict[str, np.ndarray]]:
    """Energy of the whitened residuals over dyadic blocks of every axis, against its bootstrap distribution."""
    blocks: list[tuple[str, int, int]] = []
    p, p_null, excess, maps = [], [], [], {}
    located = problem.rows.by_cluster(problem.rows.located) == 1
    for axis, position in problem.rows.coordinates.items():
        index = np.where(located, problem.rows.by_cluster(position), -1)
        size = int(index.max()) + 1
        if size < 2:
            continue
        energy = np.stack([_energy(rows, index, size) for rows in (observed, *null)])
        maps[axis] = (energy[0] - energy[1:].mean(0)) / np.maximum(energy[1:].std(0), 1e-12)
        cumulative = np.concatenate([np.zeros((len(energy), 1)), np.cumsum(energy, axis=1)], axis=1)
        for low, high in _windows(size, ordered=axis != problem.declaration.cluster):
            inside = cumulative[:, high + 1] - cumulative[:, low]
            mean, variance = np.asarray(inside[1:].mean()), np.asarray(inside[1:].var())
            tail, _ = gamma_tail(inside, mean, variance)
            blocks.append((axis, low, high))
            p.append(tail[0])
            p_null.append(tail[1:])
            excess.append(float(inside[0] - mean) / 2)
    if not blocks:
        return (), maps
    adjusted = family_wise(np.array(p), np.stack(p_null, axis=1).min(axis=1))
    found = [
        CoordinateFinding(*block, p_value=float(adjusted[i]), excess=excess[i])
        for i, block in enumerate(blocks)
        if adjusted[i] < 0.01
    ]
    return _without_overlap(found), maps


def _energy(rows: np.ndarray, index: np.ndarray, size: int) -> np.ndarray:
    keep = index >= 0
    return np.bincount(index[keep], weights=(rows[keep] ** 2), minlength=size)


def _windows(size: int, *, ordered: bool) -> Iterator[tuple[int, int]]:
    """Single positions; on ordered axes also half-overlapping blocks of dyadic length below the whole."""
    length = 1
    while length < size:
        for low in range(0, size - length + 1, max(length // 2, 1)):
            yield low, low + length - 1
        length *= 2
        if not ordered:
            return


def _without_overlap(found: list[CoordinateFinding]) -> tuple[CoordinateFinding, ...]:
    """The strongest blocks of each axis, none overlapping a stronger one."""
    kept: list[CoordinateFinding] = []
    for block in sorted(found, key=lambda b: (b.p_value, -b.excess / (b.high - b.low + 1))):
        if all(b.axis != block.axis or b.high < block.low or block.high < b.low for b in kept):
            kept.append(block)
    return tuple(kept[:12])
