"""A Gaussian process for what the model leaves, as in the calibration of computer models.

Source: Kennedy & O'Hagan, J. R. Stat. Soc. B 63 (2001) 425. The process has a squared-exponential kernel over the
standardised inputs of each observation, by random Fourier features (Rahimi & Recht, NIPS 2007), and adds to the locations
of observations in units of their noise; its length scale and variance are those of the largest marginal likelihood, the
nuisances integrated out with it.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from dtprob.gap.model.problem import Problem
from dtprob.gap.withheld.rivals.claim import Claim
from dtprob.gap.withheld.rivals.look import Look, chance

LENGTHS: Final = (0.2, 0.5, 1.0, 2.0)
"""Length scales, in standard deviations of the inputs times the root of their number."""
VARIANCES: Final = np.geomspace(1e-4, 1e2, 13)
"""Variances of the process over that of the noise."""
_FEATURES: Final = 96
_MOST_COLUMNS: Final = 8
"""Columns of an array of the data up to which it counts as inputs."""
_EXPLAINED: Final = 0.5
"""Share of the process that a candidate must explain to be named."""


def gaussian_process(seen: Look) -> Claim:
    """Rank candidates by the share of the fitted process that each explains; without half of it the cause is unlisted.

    The alarm is the largest log Bayes factor of a process against none.

    Args:
        seen: the base fit.
    """
    rows = seen.drawn.rows
    found = [_at(seen, rows, length) for length in LENGTHS]
    evidence = np.max([values.max(axis=1) for values, _, _ in found], axis=0)
    values, features, curvature = max(found, key=lambda f: f[0][0].max())
    variance = float(VARIANCES[int(np.argmax(values[0]))])
    score = np.einsum("cmf,cm->f", features, rows[0])
    weights = np.linalg.solve(curvature + np.eye(len(score)) / variance, score)
    share = _shares(seen, features, weights, float(weights @ curvature @ weights))
    ranking = tuple(seen.names[i] for i in np.argsort(-share, kind="stable"))
    return Claim(chance(evidence), ranking[:1], ranking, unlisted=bool(share.max(initial=0.0) < _EXPLAINED))


def evidences(
    curvature: Float[np.ndarray, "f f"], score: Float[np.ndarray, "n f"]
) -> Float[np.ndarray, "n variance"]:
    """Log Bayes factors of normal weights with each of `VARIANCES` against none.

    Args:
        curvature: F'PF of features F, P what removes the nuisances.
        score: F'Pr of residuals r.
    """
    values, vectors = np.linalg.eigh(curvature)
    values = np.maximum(values, 0.0)
    spread = 1 + VARIANCES[:, None] * values
    square = (score @ vectors)[:, None, :] ** 2
    return 0.5 * (VARIANCES[:, None] * square / spread - np.log(spread)).sum(axis=-1)


def _at(seen: Look, rows: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evidences (1 + replicate, variance), features (cluster, row, feature) and their curvature at a length scale."""
    features = _features(seen.problem, length)
    adjusted, _ = seen.projection.adjust(features)
    flat = features.reshape(-1, features.shape[-1])
    curvature = flat.T @ adjusted.reshape(flat.shape)
    score = rows.reshape(len(rows), -1) @ flat
    return evidences((curvature + curvature.T) / 2, score), features, curvature


def _shares(seen: Look, features: np.ndarray, weights: np.ndarray, norm: float) -> np.ndarray:
    """Share of the process, as far as the nuisances do not imitate it, along each candidate's tangents."""
    share = np.zeros(len(seen.effects))
    process, _ = seen.projection.adjust((features @ weights)[..., None])
    inner = np.einsum("cmk,cm->k", seen.columns, process[..., 0])
    for k, group in enumerate(seen.scores.groups):
        share[k] = float(((inner[group] @ seen.scores.root(k)) ** 2).sum()) / max(norm, 1e-300)
    return share


def _features(problem: Problem, length: float) -> np.ndarray:
    """Random Fourier features (cluster, row, feature) of unit variance at every location, each component its own."""
    rng, located = np.random.default_rng(0), _located(problem)
    parts, most = [], max(located.values())
    for site, components in problem.rows.components.items():
        x = inputs(problem, site)
        frequency = rng.standard_normal((x.shape[-1], _FEATURES)) / (length * np.sqrt(max(x.shape[-1], 1)))
        wave = np.sqrt(2 / _FEATURES) * np.cos(x @ frequency + rng.uniform(0, 2 * np.pi, _FEATURES))
        part = np.zeros((components, *x.shape[:-1], most, _FEATURES))
        for component in range(located[site]):
            part[component, ..., component, :] = wave
        parts.append(part.reshape(-1, most * _FEATURES))
    flat = np.concatenate([*parts, np.zeros((1, most * _FEATURES))])
    return flat[problem.rows.gather]


def _located(problem: Problem) -> dict[str, int]:
    """How many components of each observed site stand for its location; they come first."""
    found, low = {}, 0
    for site, components in problem.rows.components.items():
        size = problem.declaration.sites[site].size
        marks = problem.rows.located[low : low + components * size].reshape(components, -1)
        found[site], low = int(marks[:, 0].sum()), low + components * size
    return found


def inputs(problem: Problem, site: str) -> Float[np.ndarray, "*site input"]:
    """What varies from one observation to the next: its place along each axis, and the model's arguments there.

    An argument counts when its leading axes are as long as the site's and what is left are few columns; the observed values
    themselves do not. Each input has mean 0 and variance 1.

    Args:
        problem: the model on its data.
        site: an observed site.
    """
    shape = problem.declaration.sites[site].shape
    columns = [np.broadcast_to(g, shape) for g in np.indices(shape, dtype=float)]
    observed = [np.asarray(v) for v in problem.observed.values.values()]
    for value in problem.data.values():
        array = np.asarray(value) if hasattr(value, "shape") else np.zeros(())
        if np.iscomplexobj(array) or any(
            array.shape == o.shape and np.array_equal(array, o) for o in observed
        ):
            continue
        same = _leading(array.shape, shape)
        rest = array.reshape(*array.shape[:same], -1).astype(float)
        if same and rest.shape[-1] <= _MOST_COLUMNS:
            rest = rest.reshape(*rest.shape[:same], *(1,) * (len(shape) - same), rest.shape[-1])
            columns += [np.broadcast_to(rest[..., j], shape) for j in range(rest.shape[-1])]
    centred = [c - c.mean() for c in columns]
    varying = [
        c / c.std() for c in centred if c.std() > 1e-12 * max(float(np.abs(c).max(initial=0.0)), 1e-300)
    ]
    return np.stack(varying, axis=-1) if varying else np.zeros((*shape, 0))


def _leading(shape: tuple[int, ...], site: tuple[int, ...]) -> int:
    """Number of leading axes of the same length."""
    count = 0
    while count < min(len(shape), len(site)) and shape[count] == site[count]:
        count += 1
    return count
