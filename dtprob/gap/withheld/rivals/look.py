"""A fit as all rivals see it: first-order scores of every candidate, of the data and of data sets drawn at the fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.bootstrap import Replicates, replicate
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.plausible import is_one_sided, sizes
from dtprob.gap.fitting.projection import Projection, project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.tails import deviation, gamma_tail
from dtprob.gap.which.directions import surroundings, tangents
from dtprob.gap.which.places import Placed, place
from dtprob.gap.which.scores import Scores, mean_scores

_NOTHING = 1e-300


@dataclass(frozen=True)
class Look:
    """First-order view of the candidates at a fit; index 0 of what has replicates is the data.

    Attributes:
        problem, fitted, projection, drawn: the model, its fit, what the fit removes, and data sets drawn there.
        effects: the candidates that the fit does not contain, those with parameters of their own first.
        columns: whitened tangents (cluster, row, column) of the effects with parameters of their own.
        scores: of these effects, adjusted for the nuisances.
        u: the same scores, (1 + replicate, column).
        unadjusted: information (column, column) as if the nuisances were known.
        field_log_p: log p-value of each random field by its energy, (1 + replicate, field).
        gain: nats that each candidate brings at its best size, (1 + replicate, effect).
        size: number of parameters of each candidate that the data can see.
    """

    problem: Problem
    fitted: Fit
    projection: Projection
    drawn: Replicates
    effects: tuple[Effect, ...]
    columns: np.ndarray
    scores: Scores
    u: Float[np.ndarray, "n column"]
    unadjusted: Float[np.ndarray, "column column"]
    field_log_p: Float[np.ndarray, "n field"]
    gain: Float[np.ndarray, "n effect"]
    size: Float[np.ndarray, " effect"]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the candidates."""
        return tuple(effect.name for effect in self.effects)


def look(problem: Problem, fitted: Fit, key: jax.Array, settings: Settings) -> Look:
    """Score every candidate at a fit.

    Args:
        problem: the model and candidates on their data.
        fitted: where to look.
        key: of the replicates.
        settings: how many replicates there are: as many as site tests have.
    """
    projection = project(problem, fitted)
    drawn = replicate(
        problem, fitted, projection, key, replace(settings, replicates=settings.site_replicates)
    )
    problem, placed = place(problem, fitted, drawn)
    left = [e for e in problem.effects if e.name not in fitted.effects]
    means = [e for e in left if e.kind == "mean"]
    fields = [e for e in left if e.kind == "variance"]
    around = surroundings(problem, fitted.x)
    found = tangents(around, means, problem.programs)
    scores = mean_scores(problem, projection, drawn, found)
    u = _paid(scores, np.concatenate([scores.u[None], scores.u_null]), placed)
    energies = problem.programs.field_energy(around.grown(), drawn.gradients, fields) if fields else {}
    log_p = [_field_log_p(energies[e.name], placed.get(e.name)) for e in fields]
    square, size = _mean_gains(scores, u)
    told = [_field_gain(energies[e.name], placed.get(e.name)) for e in fields]
    gain = np.concatenate([square, *(one[:, None] for one in told)], axis=1)
    return Look(
        problem=problem,
        fitted=fitted,
        projection=projection,
        drawn=drawn,
        effects=(*means, *fields),
        columns=found.columns,
        scores=scores,
        u=u,
        unadjusted=_unadjusted(scores, found.columns),
        field_log_p=np.stack(log_p, axis=1) if log_p else np.zeros((len(u), 0)),
        gain=gain,
        size=np.concatenate([size, np.ones(len(fields))]),
    )


def _paid(scores: Scores, u: np.ndarray, placed: Mapping[str, Placed]) -> np.ndarray:
    """Scores, those of effects at their best places only as large as their chance after the choice of the place."""
    u = u.copy()
    for effect, group in zip(scores.effects, scores.groups, strict=True):
        if effect.name in placed:
            found, own = placed[effect.name], group[sizes(effect)[0]]
            p = np.array([found.p_value, *found.replicate_p])
            t = deviation(p, one_sided=is_one_sided(effect))
            u[:, own] = t * np.sqrt(scores.information[own, own])
    return u


def chance(statistic: Float[np.ndarray, " n"]) -> float:
    """Exact p-value of the first of exchangeable statistics, large ones against the null."""
    return float(np.mean(statistic >= statistic[0]))


def _mean_gains(scores: Scores, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half the squared adjusted score, and the number of directions, of each effect."""
    gain, size = np.zeros((len(u), len(scores.effects))), np.zeros(len(scores.effects))
    for k, (effect, group) in enumerate(zip(scores.effects, scores.groups, strict=True)):
        root = scores.root(k)
        t = u[:, group] @ root
        if is_one_sided(effect) and root.size:
            t = np.maximum(t * np.sign(root[sizes(effect)[0], 0]), 0.0)
        gain[:, k], size[k] = 0.5 * (t**2).sum(axis=1), root.shape[1]
    return gain, size


def _field_log_p(energy: Float[np.ndarray, "n weighting"], placed: Placed | None) -> Float[np.ndarray, " n"]:
    """Log p-value of a random field by its energy, the smallest over weightings; the choice of a place is paid for."""
    if placed is not None:
        return np.log(np.array([placed.p_value, *placed.replicate_p]))
    return np.log(gamma_tail(energy, energy[1:].mean(0), energy[1:].var(0))[0]).min(axis=1)


def _field_gain(energy: Float[np.ndarray, "n weighting"], placed: Placed | None) -> Float[np.ndarray, " n"]:
    """Nats of a random field's best spread, for entries of equal information: nu / 2 (r - 1 - log r).

    Args:
        energy: of the data and of replicates.
        placed: how the place was found, of an effect that may act anywhere: the choice is paid for.
    """
    if placed is not None:
        p = np.array([placed.p_value, *placed.replicate_p])
        return 0.5 * np.maximum(deviation(p, one_sided=True), 0.0) ** 2
    mean, variance = energy[1:].mean(axis=0), energy[1:].var(axis=0)
    safe = np.maximum(mean, _NOTHING)
    nu = 2 * safe**2 / np.maximum(variance, 1e-12 * safe**2)
    ratio = np.maximum(energy / safe, 1.0)
    return np.where(mean > 0, nu / 2 * (ratio - 1 - np.log(ratio)), 0.0).max(axis=1)


def _unadjusted(scores: Scores, columns: np.ndarray) -> np.ndarray:
    """Information without the nuisances' part; rows that only an effect's own distribution has are in its total."""
    information = np.array(jnp.einsum("cmi,cmj->ij", columns, columns))
    np.fill_diagonal(information, scores.total)
    return information
