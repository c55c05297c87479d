"""First-order directions of effects at a fit, without compiling the effects.

The derivative of each rewrite in its parameters is taken at the values that the sites have; pushing these small arrays
through the compiled model gives the effect's whitened tangents, and pulling site gradients back through a random field's
rewrite gives the scores of a variance effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.effects.effect import Context, Effect
from dtprob.gap.fitting.centred import Centred
from dtprob.gap.model.problem import Problem
from dtprob.gap.model.programs import Programs
from dtprob.gap.model.quick import quick_jit
from dtprob.gap.model.rewrites import null_vector, unflatten
from dtprob.gap.model.tangents import CHUNK
from dtprob.gap.observation import whiten


@dataclass(frozen=True)
class Surroundings:
    """What effects see at a fit: data, values of the sites, parameters of the observed distributions."""

    problem: Problem
    x: np.ndarray
    values: Mapping[str, jax.Array]
    observations: Mapping[str, whiten.Observation]

    def grown(self) -> dict[str, jax.Array]:
        """Values of the sites, each in the largest shape that a candidate gives it."""
        sizes = self.problem.float_sites
        return {
            n: jnp.broadcast_to(v, sizes[n].shape) if n in sizes else jnp.asarray(v)
            for n, v in self.values.items()
        }

    @property
    def context(self) -> Context:
        """Data and sites by name."""
        return Context(self.problem.data, self.values)


@dataclass(frozen=True)
class Extra:
    """Rows that only a rewritten distribution has, such as a score of its tail.

    Attributes:
        site: the observed site.
        shift: whitened shifts (row, parameter).
        null: the rewritten distribution at the effect's null.
        first: number of components that the base distribution has.
    """

    site: str
    shift: np.ndarray
    null: whiten.Observation
    first: int

    def score(self, values: jax.Array) -> np.ndarray:
        """Scores (n, parameter) of observed values (n, ...)."""
        null = self.null
        return np.asarray(_scores(null.parameters, values, self.shift, family=null.family, first=self.first))


@partial(quick_jit, static_argnames=("family", "first"))
def _scores(
    parameters: whiten.Parameters, values: jax.Array, shift: np.ndarray, *, family: str, first: int
) -> jax.Array:
    null = whiten.about(whiten.Observation(family, parameters))

    def one(value: jax.Array) -> jax.Array:
        return null.residual(value)[first:].reshape(-1) @ shift

    return jax.lax.map(one, values)


@dataclass(frozen=True)
class Tangents:
    """Whitened tangents of mean effects.

    Attributes:
        effects: in the order of the columns.
        groups: for each effect its columns.
        columns: (cluster, row, column); by far the largest array of a diagnosis, so no copy of it is made.
        extra: rows beyond the base model's, by effect name.
    """

    effects: tuple[Effect, ...]
    groups: tuple[np.ndarray, ...]
    columns: np.ndarray
    extra: Mapping[str, tuple[Extra, ...]]


def surroundings(problem: Problem, x: np.ndarray) -> Surroundings:
    """Evaluate the sites and observed distributions at x."""
    return Surroundings(problem, x, problem.compiled.sites(x), problem.compiled.observations(x))


def tangents(
    around: Surroundings,
    effects: Sequence[Effect],
    programs: Programs,
    centre: Centred | None = None,
) -> Tangents:
    """Whitened tangents of mean effects at their null.

    Args:
        around: the fit.
        effects: which.
        programs: of all candidates.
        centre: how scores are centred on the prior of clusters' own unknowns.
    """
    problem = around.problem
    sizes = [e.dimension for e in effects]
    groups = tuple(np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])) if effects else ()
    places = [(effect.name, j) for effect in effects for j in range(effect.dimension)]
    columns = np.zeros((*problem.rows.gather.shape, len(places)))
    found = programs.site_tangents(around.grown(), problem.effects)
    there = None if centre is None else surroundings(problem, centre.x)
    found_there = {} if there is None else programs.site_tangents(there.grown(), problem.effects)
    for low in range(0, len(places), CHUNK):
        part = places[low : low + CHUNK]
        shifts = _shifts(around, found, part)
        if centre is not None and there is not None:
            shifts = centre.columns(shifts, _shifts(there, found_there, part))
        columns[..., low : low + len(part)] = shifts
    extra: dict[str, tuple[Extra, ...]] = {}
    for effect, group in zip(effects, groups, strict=True):
        rows, extra[effect.name] = _distribution_tangents(around, effect)
        if rows is not None:
            columns[..., group] += rows
    return Tangents(tuple(effects), groups, columns, extra)


def _shifts(
    around: Surroundings, found: Mapping[str, Mapping[str, jax.Array]], places: Sequence[tuple[str, int]]
) -> np.ndarray:
    """Shifts (cluster, row, n) of some parameters; zero where there is no derivative: such an effect says nothing here."""
    problem = around.problem
    deltas = _deltas(problem, found, places)
    if not deltas:
        return np.zeros((*problem.rows.gather.shape, len(places)))
    shifts = np.asarray(problem.compiled.site_shift(around.x, deltas))
    return np.where(np.isfinite(shifts).all(axis=(0, 1)), shifts, 0.0)


def _deltas(
    problem: Problem, found: Mapping[str, Mapping[str, jax.Array]], places: Sequence[tuple[str, int]]
) -> dict[str, np.ndarray]:
    """Perturbations (n, *site) of the sites that some parameters (effect, number) move."""
    deltas: dict[str, np.ndarray] = {}
    for i, (name, j) in enumerate(places):
        for site, tangent in found.get(name, {}).items():
            if site in problem.float_sites:
                like = problem.float_sites[site]
                into = deltas.setdefault(site, np.zeros((len(places), *like.shape), like.dtype))
                into[i] = np.asarray(tangent)[..., j]
    return deltas


def _distribution_tangents(
    around: Surroundings, effect: Effect
) -> tuple[jax.Array | None, tuple[Extra, ...]]:
    """Shifts (cluster, row, parameter) of the base model's rows, and rows of its own, of a rewritten distribution."""
    if not effect.distributions:
        return None, ()
    null, extra = null_vector(effect), []
    base_rows: list[dict[str, jax.Array]] = [{} for _ in range(len(null))]
    for site, observation in around.observations.items():
        shape = (around.problem.rows.components[site], *around.problem.declaration.sites[site].shape)
        rewrite = effect.distributions.get(site)
        if rewrite is None:
            for rows in base_rows:
                rows[site] = jnp.zeros(shape)
            continue
        value = around.problem.observed.values[site]  # of censored readings it tells the limits

        def parameters(flat: jax.Array, site: str = site, rewrite: Any = rewrite, value: Any = value) -> Any:
            fn = rewrite(
                whiten.distribution(around.observations[site]), unflatten(effect, flat), around.context
            )
            return whiten.rewritten(around.observations[site], fn, value, site).parameters

        moved = rewrite(whiten.distribution(observation), effect.null(), around.context)
        new = whiten.rewritten(observation, moved, value, site)
        shifts = []
        for j, basis in enumerate(jnp.eye(len(null))):
            shift = whiten.shift(new, jax.jvp(parameters, (null,), (basis,))[1])
            base_rows[j][site] = shift[: shape[0]]
            shifts.append(np.asarray(shift[shape[0] :]).reshape(-1))
        if shifts[0].size:
            extra.append(Extra(site, np.stack(shifts, axis=-1), new, shape[0]))
    stacked = [around.problem.rows.stack(rows) for rows in base_rows]
    return jnp.stack(stacked, axis=-1), tuple(extra)
