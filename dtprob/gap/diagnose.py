"""Diagnose the gap between a model and data: which effect, where, how far, or none of the known ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType

import jax
import numpy as np

from dtprob.effects.effect import Effect
from dtprob.effects.library import catalogue
from dtprob.errors import InputError
from dtprob.gap.compose import compose
from dtprob.gap.decide import decide
from dtprob.gap.diagnosis import Cause, Diagnosis
from dtprob.gap.evidence import Evidence
from dtprob.gap.fitting.integrated import based
from dtprob.gap.fitting.soundness import check_noise, check_possible, idle, lopsided, notes
from dtprob.gap.fitting.states import held
from dtprob.gap.how_far import closed
from dtprob.gap.how_far.remainder import model_remainder
from dtprob.gap.how_far.shares import shares
from dtprob.gap.how_far.terms import check_tolerance
from dtprob.gap.keys import key_for
from dtprob.gap.model.nulls import check_nulls
from dtprob.gap.model.problem import Problem
from dtprob.gap.next_measurement.design_data import next_measurement
from dtprob.gap.settings import Settings
from dtprob.gap.view import View
from dtprob.gap.where.data_columns import check_finite
from dtprob.gap.where.read_twice import read_twice
from dtprob.gap.where.site_finding import likely_left, most_left
from dtprob.gap.which.classes import credible
from dtprob.gap.which.confirm import confirm
from dtprob.gap.which.search import search
from dtprob.gap.which.trials import Say, credit
from dtprob.inference.engine import AbstractEngine, check_key
from dtprob.inference.fit import resolve
from dtprob.inference.posterior import Sampler
from dtprob.models.arguments import Data, Model, doubled, taking
from dtprob.models.declaration import declare
from dtprob.models.indices import check_indices
from dtprob.models.support import check_support
from dtprob.models.supported import differentiated_forwards

_DEFAULT = Settings()


def diagnose(
    model: Model,
    data: Data,
    effects: str | Iterable[str | Effect] = (),
    *,
    key: jax.Array,
    engine: str | AbstractEngine = "laplace",
    cluster: str | None = None,
    settings: Settings = _DEFAULT,
    reference: Sampler | None = None,
    designs: Mapping[str, Data] = MappingProxyType({}),
    say: Say = lambda _: None,
) -> Diagnosis:
    """Find out why data differ from a model.

    Args:
        model: the base model, any NumPyro function with named deterministic sites.
        data: its arguments by name.
        effects: the candidates, by name or effects of one's own, or "all" that the model and the data allow; see
            `dtprob.effects.catalogue`. Without any, the diagnosis tells whether and where there is a gap.
        key: typed JAX key; the verdict does not depend on it beyond the declared error rates.
        engine: the engine that confirms the accepted causes and gives their sizes, or its name.
        cluster: axis, or column of the data (of the model's arguments or not), whose values are independent of one another;
            by default the model's own.
        settings: levels and effort.
        reference: posterior of the model on earlier data; it becomes the prior of the nuisances, so that a change of a
            parameter is a gap and not absorbed by a new fit.
        designs: arguments of the model for measurements that could be made, by name; where causes cannot be told apart, the
            report ranks them. Observed values in them are not looked at.
        say: receives one line at each stage, for progress.

    Raises:
        InputError: an argument of another kind, unknown effects, effects on absent sites, effects that change the
            model at their null, fewer than four clusters, as many unknowns that clusters share as there are data,
            indices in data beyond an array's end, columns with missing values, observed values that their
            distribution cannot take or that are impossible under the base model, a base model that does not fit, or
            one that meets the data exactly.
    """
    check_key(key)
    if not isinstance(settings, Settings):
        got, remedy = type(settings).__name__, "Write dtprob.gap.Settings(...)"
        raise InputError("settings of a diagnosis", "Settings", got, remedy)
    if reference is not None and not callable(getattr(reference, "sample", None)):
        got, remedy = type(reference).__name__, "Give what dtprob.fit(model, earlier_data, ...) returns"
        raise InputError("reference of a diagnosis", "a posterior", got, remedy)
    with jax.enable_x64(True):
        data, designs = doubled(data), {name: doubled(one) for name, one in designs.items()}
        return _diagnose(
            taking(model, data, cluster),
            data,
            effects,
            key=key,
            engine=resolve(engine) if isinstance(engine, str) else engine,
            cluster=cluster,
            settings=settings,
            reference=reference,
            designs=designs,
            say=say,
        )


def _diagnose(
    model: Model,
    data: Data,
    effects: str | Iterable[str | Effect],
    *,
    key: jax.Array,
    engine: AbstractEngine,
    cluster: str | None,
    settings: Settings,
    reference: Sampler | None,
    designs: Mapping[str, Data],
    say: Say,
) -> Diagnosis:
    """`diagnose` in double precision, its arguments checked."""
    check_indices(model, data)
    check_support(model, data)
    problem = Problem(model, data, _candidates(model, data, effects), cluster, reference)
    if (told := int((problem.n_observation_of_each > 0).sum())) < 4:
        raise InputError(
            "clusters",
            "at least 4 independent ones",
            f"{told} along {problem.cluster_name!r}",
            "Give more links, episodes or segments, or another cluster axis.",
        )
    shared = len(held(problem))
    if shared >= problem.observed.count:
        raise InputError(
            f"latent sites without entries of their own for each of {problem.cluster_name!r}",
            f"fewer unknowns than the {problem.observed.count} observed values",
            str(shared),
            "Leave some out, or choose a cluster that has entries of its own.",
        )
    check_nulls(problem)
    check_finite(problem)
    evidence = _gather(problem, key, settings, say)
    causes = _causes(evidence, key_for(key, "confirm"), engine, settings, say)
    verdict = decide(evidence, causes, settings)
    found = compose(evidence, causes, verdict, settings=settings, engine=engine, key=key)
    plan = next_measurement(evidence, causes, designs) if verdict == "UNDETERMINED" else None
    return replace(found, sections={**found.sections, "next_measurement": plan})


def _candidates(model: Model, data: Data, effects: str | Iterable[str | Effect]) -> tuple[Effect, ...]:
    """The effects, those by name among them taken from the library."""
    if effects != "all":
        given = (effects,) if isinstance(effects, str) else tuple(effects)
        if (own := tuple(e for e in given if isinstance(e, Effect))) == given:
            return own
        effects = given
    return catalogue(declare(model, data).sites, data, effects)


def _gather(problem: Problem, key: jax.Array, settings: Settings, say: Say) -> Evidence:
    noted = [*lopsided(problem), *read_twice(problem)]
    for note in noted:
        say(f"note: {note}")
    say(f"fitting the base model to {problem.n_cluster} clusters ({problem.cluster_name})")
    with differentiated_forwards():
        start = based(problem, key_for(key, "base"), polished=settings.polished, say=say)
    problem, base = start.problem, start.fitted
    check_possible(problem, base)
    check_noise(problem, base)
    check_tolerance(problem, problem.compiled.misses(base.x), settings.tolerance_db)
    of_fit = notes(problem, base)
    for note in of_fit:
        say(f"note: {note}")
    searched = search(problem, base, key_for(key, "search"), settings, say)
    steps = searched.steps
    noted = (*noted, *of_fit, *idle(steps[0].view.screening.absorbed_by))
    problem, base, last = steps[0].view.problem, steps[0].view.fitted, steps[-1].view
    say("judging on held-out clusters")
    assignment = closed.folds(problem.n_cluster, settings.folds)
    folds = list(closed.fold_fits(problem, base, assignment))
    held_before = held_after = closed.judged(problem, folds)
    if last is not steps[0].view:
        folds = list(closed.fold_fits(last.problem, last.fitted, assignment))
        held_after = closed.judged(last.problem, folds)
    wrong = [s for s in last.location.sites if s.p_value <= settings.level / 2]
    asked_for = _asked_for(last, settings)
    remains = bool(wrong)
    by_sites = most_left(wrong) if remains else likely_left(last.location.sites)
    left = max([by_sites, *map(last.screening.promise_of, asked_for)])
    floor = closed.floor(last.problem, last.fitted, held_after, left, len(np.unique(assignment)))
    held = held_before, held_after
    fraction = closed.closed_fraction(*held, floor, key_for(key, "closed")) if last.fitted.effects else None
    parts = (
        shares(last.problem, last.fitted, held, assignment, key_for(key, "shares"))
        if fraction is not None
        else ()
    )
    rest = None
    # even if scores say that little is left, as where a wide spread hides it
    if settings.remainder and any(site.can_be_modelled for site in wrong):
        say("modelling what is left at its site")
        rest = model_remainder(last, folds, held_after, floor.best, key_for(key, "remainder"))
    if rest is not None:
        floor = closed.shown(floor, held_after, rest.held)
        fraction = (
            closed.closed_fraction(*held, floor, key_for(key, "closed")) if last.fitted.effects else None
        )
    return Evidence(
        problem=problem,
        base=base,
        steps=tuple(steps),
        held_before=held_before,
        held_after=held_after,
        floor=floor,
        fraction=fraction,
        shares=parts,
        notes=noted,
        remainder=rest,
        rivals=searched.rivals,
        asked_for=asked_for,
    )


def _asked_for(last: View, settings: Settings) -> tuple[str, ...]:
    """The candidate that the scores call for most, where as many effects as are looked for have been accepted."""
    if len(last.fitted.effects) < settings.max_effects or not last.screening.shows_gap(settings):
        return ()
    return (last.screening.names[int(np.argmax(last.screening.log_bayes_factor))],)


def _causes(
    evidence: Evidence, key: jax.Array, engine: AbstractEngine, settings: Settings, say: Say
) -> tuple[Cause, ...]:
    if not evidence.accepted:
        return ()
    say(f"confirming {', '.join(evidence.accepted)} with {type(engine).__name__}")
    effects = [e for e in evidence.last.problem.effects if e.name in evidence.accepted]
    own = evidence.last.problem, evidence.fitted, effects
    sizes, plausible = confirm(*own, key_for(key, "sizes"), engine)
    classes, probability = alternatives(evidence, settings)
    first = min(effects, key=lambda effect: effect.kind == "variance")  # as their sizes are told
    estimates = evidence.held_after.estimates[first.site_name(first.parameters[0].name)]
    strata = tuple(float(v) for v in estimates[:, 0])
    physics = " ".join(e.physics for e in effects if e.physics)
    held, but_for_fields = (evidence.held_before, evidence.held_after), evidence.floor.of_known_fields
    closes = {share.effect: share.mean for share in evidence.shares}
    cause = Cause(
        effects=tuple(sorted(evidence.accepted, key=lambda name: -closes.get(name, 0.0))),
        alias_class=classes,
        probability=probability,
        size=sizes,
        closed_fraction=evidence.fraction,
        explained=None
        if evidence.fraction is None
        else closed.share(*held, but_for_fields, key_for(key, "explained")),
        parameters=evidence.floor.parameters,
        shares=evidence.shares,
        physics=physics,
        strata=strata,
        plausible=plausible,
    )
    return (cause,)


def alternatives(evidence: Evidence, settings: Settings) -> tuple[tuple[tuple[str, ...], ...], float]:
    """Sets that differ from the accepted one in one effect and that the data cannot rule out; its probability."""
    found = evidence.explanations
    worth = {names: credit(evidence.problem, one.fitted, evidence.base) for names, one in found.items()}
    return credible(worth, evidence.accepted, settings.credibility)
