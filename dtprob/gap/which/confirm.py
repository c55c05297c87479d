"""Confirmation of the accepted causes by a real engine: the posterior of the extended model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import jax
import numpy as np

from dtprob.effects.effect import FIELD, Effect, Meaning, Parameter
from dtprob.effects.rewriting import with_effects
from dtprob.gap.diagnosis import Size
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.active import activate
from dtprob.gap.fitting.bounded import Bounded, bounded_draws
from dtprob.gap.fitting.density import system_at
from dtprob.gap.fitting.determined import interval_of_spread
from dtprob.gap.fitting.informed import informed
from dtprob.gap.fitting.plausible import limits, nulls, plausible_spread, scales
from dtprob.gap.model.problem import Problem
from dtprob.gap.which.stepped import place_draws, stepped
from dtprob.inference.engine import LATENTS_ONLY, AbstractEngine
from dtprob.inference.laplace import Laplace

_Z90 = 1.6449


def confirm(
    problem: Problem, fitted: fitting.Fit, effects: Sequence[Effect], key: jax.Array, engine: AbstractEngine
) -> tuple[tuple[Size, ...], bool]:
    """Posterior sizes of the accepted effects, and whether their priors call them plausible.

    Effects with parameters of their own go through `engine` on the extended model, started at the refit; the standard
    deviation of a variance effect comes from the refit, where its field is integrated out.
    """
    means = [e for e in effects if e.kind == "mean"]
    found: list[Size] = []
    if means:
        posterior = _posterior(problem, fitted, effects, key, engine)
        for effect in means:
            for parameter in effect.parameters:
                draws = posterior[effect.site_name(parameter.name)]
                found += _sizes(
                    parameter, draws.reshape(-1, *parameter.shape), prefix=_prefix(effect, effects)
                )
    for effect in effects:
        if effect.kind == "variance":
            found += _spread(problem, fitted, effect, prefix=_prefix(effect, effects))
    return tuple(found), all(_plausible(e, fitted, problem) for e in effects)


def _posterior(
    problem: Problem, fitted: fitting.Fit, effects: Sequence[Effect], key: jax.Array, engine: AbstractEngine
) -> dict[str, np.ndarray]:
    """Draws of the parameters of mean effects by site, of the engine, or of the refit's own normal approximation.

    The refit is a mode with its curvature, so for `Laplace` there is nothing to run again.
    """
    means = [e for e in effects if e.kind == "mean"]
    if isinstance(engine, Laplace):
        return _normal(problem, fitted, means, key, engine.draws)
    fields = _fields_at(problem, fitted, effects)
    started = _start_at(engine, {**problem.initial(fitted.x, means), **fields})
    model = with_effects(informed(problem.model, problem.known), effects)
    posterior = started(key, model, problem.data, options=LATENTS_ONLY)
    return {name: np.asarray(draws) for name, draws in posterior.draws.items()}


def _normal(
    problem: Problem, fitted: fitting.Fit, means: Sequence[Effect], key: jax.Array, count: int
) -> dict[str, np.ndarray]:
    """Draws of the refit's own normal approximation, within what the effects' priors allow; a step's place by its own."""
    active = activate(problem, fitted.effects, spread=fitted.spread)
    gradient = system_at(problem, active, fitted.x).gradient
    pushed = fitting.pushed_out(problem, active, fitted.x, gradient)
    mean = fitted.x[fitted.global_index] + fitted.covariance @ pushed
    low, high = np.full(len(mean), -np.inf), np.full(len(mean), np.inf)
    for effect in means:
        place = np.searchsorted(fitted.global_index, problem.layout.of(effect))
        low[place], high[place] = limits(effect)
    rng = np.random.default_rng(np.asarray(jax.random.bits(key, (4,))))
    draws = bounded_draws(Bounded(mean, fitted.covariance, low, high), count, rng)
    for coordinate in stepped(problem, active, fitted):
        draws[:, coordinate] = place_draws(problem, active, fitted, coordinate, count=count, rng=rng)
    names = [e.site_name(p.name) for e in means for p in e.parameters]
    return {n: draws[:, np.searchsorted(fitted.global_index, problem.layout[n].index[0])] for n in names}


def _fields_at(problem: Problem, fitted: fitting.Fit, effects: Sequence[Effect]) -> dict[str, np.ndarray]:
    """Where random fields start: entries of unit spread, their standard deviations, and their places."""
    found: dict[str, np.ndarray] = {}
    for effect in (e for e in effects if e.kind == "variance"):
        spread, block = fitted.spread[effect.name], problem.field_of(effect)
        found[effect.site_name(FIELD)] = np.asarray(problem.layout.part(fitted.x, block.name)) / spread
        for parameter in effect.parameters:
            name = effect.site_name(parameter.name)
            at = problem.layout.part(fitted.x, name) if parameter.is_place else spread
            found[name] = np.broadcast_to(at, parameter.shape)
    return found


def _start_at(engine: AbstractEngine, initial: Mapping[str, Any]) -> AbstractEngine:
    """The engine, started at given values where it can be."""
    settings = {f.name for f in fields(engine)}  # pyright: ignore[reportArgumentType]
    changes: dict[str, Any] = {"initial": initial} if "initial" in settings else {}
    if "starts" in settings:
        changes["starts"] = 1
    return replace(engine, **changes) if changes else engine  # pyright: ignore[reportArgumentType]


def _prefix(effect: Effect, effects: Sequence[Effect]) -> str:
    return "" if len(effects) == 1 else f"{effect.name}."


def _sizes(parameter: Parameter, draws: np.ndarray, prefix: str) -> list[Size]:
    flat = draws.reshape(len(draws), -1)
    labels = [""] if flat.shape[1] == 1 else [f"_{label}" for label in _labels(parameter)]
    result = []
    for j, label in enumerate(labels):
        low, high = np.quantile(flat[:, j], [0.05, 0.95])
        name = f"{prefix}{parameter.name}{label}{_suffix(parameter.unit)}"
        mean, meaning = float(flat[:, j].mean()), _meaning(parameter, label)
        result.append(Size(name, mean, float(low), float(high), parameter.unit, meaning))
    return result


def _meaning(parameter: Parameter, label: str) -> Meaning | None:
    """What an entry means to people: its label follows what all of them are."""
    if parameter.meaning is None or not label:
        return parameter.meaning
    return replace(parameter.meaning, words=f"{parameter.meaning.words}{label.replace('_', ' ')}")


def _labels(parameter: Parameter) -> Sequence[str]:
    return parameter.labels or ["_".join(map(str, index)) for index in np.ndindex(*parameter.shape)]


def _suffix(unit: str) -> str:
    """The unit as the end of a key, as in `delay_s`; nothing for a pure number."""
    return "" if unit == "1" else "_" + unit.replace("/", "_per_").replace("^", "").replace(" ", "_")


def _spread(problem: Problem, fitted: fitting.Fit, effect: Effect, prefix: str) -> list[Size]:
    """The standard deviation of a variance effect's field, and its places."""
    found: list[Size] = []
    position = {int(i): j for j, i in enumerate(fitted.global_index)}
    for parameter in effect.parameters:
        if parameter.is_place:
            index = int(problem.layout[effect.site_name(parameter.name)].index[0, 0])
            middle = float(fitted.x[index])
            half = _Z90 * float(np.sqrt(fitted.covariance[position[index], position[index]]))
            low, high = middle - half, middle + half
        else:
            middle = fitted.spread[effect.name]
            low, high = interval_of_spread(problem, fitted, effect.name)
        name = f"{prefix}{parameter.name}{_suffix(parameter.unit)}"
        found.append(Size(name, middle, low, high, parameter.unit, parameter.meaning))
    return found


def _plausible(effect: Effect, fitted: fitting.Fit, problem: Problem) -> bool:
    if effect.kind == "variance":
        return fitted.spread[effect.name] <= 4 * plausible_spread(effect)
    index = problem.layout.of(effect)
    return bool(np.all(np.abs(fitted.x[index] - nulls(effect)) <= 4 * scales(effect)))
