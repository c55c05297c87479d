"""Effects found far from the null by what clusters say one by one: random fields of few entries each, and their like.

A receiver that stands wavelengths away from where it was recorded has turned its phases by many cycles: no score sees it,
and all that is left looks like noise. One set of trials, each with the same entries in all clusters, serves all clusters,
which are independent given what they share. The best trial of each is what a random field would be; the best one of all
clusters that an effect touches together is the size of an effect that is the same field with entries in common, as a
transmitter's place is to its links. Where clusters have angles of their own (a phase of each packet), all of a cluster's
are turned alike beside each trial: what a place does to the phase is the same in every packet.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from dtprob.effects.effect import Effect
from dtprob.gap.fitting.plausible import places
from dtprob.gap.fitting.sweep import turned_by
from dtprob.gap.model.problem import Problem
from dtprob.gap.which.directions import surroundings
from dtprob.gap.which.entries import Point, Trials, best, is_each
from dtprob.gap.which.scan import Found, centre

_STANDS_FOR: Final = 0.9
"""Share of what a field gains from which on an effect with entries in common is looked at in its place."""
_PROBE: Final = np.array([0.37, -0.23, 0.31])
"""Entries at which an effect is compared with a field, in steps between trials."""
_SAME: Final = 1e-6
"""Share of what entries change up to which an effect changes the same."""


def scan_each(
    problem: Problem, x: np.ndarray, names: Sequence[str], middle: np.ndarray | None = None
) -> dict[str, Found]:
    """Random fields with each cluster's entries where they are best, or nowhere if what they gain there may be chance.

    Only those whose entries have several optima, which a fit from the null does not find, and that any cluster has entries
    of. Effects that are such a field with the same entries in all clusters that they touch are found by the same trials,
    and take the field's place where they gain nearly as much. What clusters share stands once at the fit and once at the
    centre of its prior, as in `scan`.

    Args:
        problem: the model and candidates on their data.
        x: the fit.
        names: candidates to look at.
        middle: the centre of the prior, where it is known already.
    """
    effects = [e for e in problem.effects if e.name in names and is_each(problem, e)]
    here, found = float(problem.compiled.by_cluster(x).sum()), dict[str, Found]()
    anchors = (x, centre(problem, x) if middle is None else middle) if effects else ()
    for anchor in anchors:
        around, null = surroundings(problem, anchor), problem.compiled.by_cluster(anchor)
        for effect in effects:
            trials = Trials(problem, around, effect)
            if not trials.is_wavy:
                continue
            value, point = best(trials, null)
            every = {effect.name: _found(problem, anchor, value.sum() - here, point, point.entries)}
            for other, touched in _alike(trials, names, null):
                value, point = best(trials, null, touched)
                gain = value[touched][0] + null[~touched].sum() - here
                every[other] = _found(problem, anchor, gain, point, point.entries[touched][0])
            for name, one in every.items():
                if one.parameters.any() and (name not in found or one.gain > found[name].gain):
                    found[name] = one
    return _without_stood_for(found, {e.name for e in effects})


def _found(problem: Problem, anchor: np.ndarray, gain: float, point: Point, parameters: np.ndarray) -> Found:
    return Found(float(gain), turned_by(problem, anchor, point.turn), parameters)


def _without_stood_for(found: dict[str, Found], fields: set[str]) -> dict[str, Found]:
    """What was found, without fields where an effect with entries in common gains nearly as much."""
    common = max((one.gain for name, one in found.items() if name not in fields), default=-np.inf)
    return {
        name: one
        for name, one in found.items()
        if name not in fields or common < _STANDS_FOR * max(one.gain, 0.0)
    }


def _alike(
    trials: Trials, names: Sequence[str], null: Float[np.ndarray, " cluster"]
) -> Iterator[tuple[str, Bool[np.ndarray, " cluster"]]]:
    """Effects that change each cluster as the field does with those entries, or not at all; and which they change."""
    probe = _PROBE[: trials.entries] * trials.grid.spacing
    field = trials.unturned(probe)
    same = _SAME * (1.0 + np.abs(field - null))
    for effect in (e for e in trials.problem.effects if e.name in names and _may_be(e, trials)):
        terms = trials.of_effect(effect.name, probe)
        touched = np.abs(terms - null) > same
        if touched.any() and np.all(~touched | (np.abs(terms - field) <= same)):
            yield effect.name, touched


def _may_be(effect: Effect, trials: Trials) -> bool:
    """Whether an effect has as many sizes as a cluster has entries, and rewrites the same sites."""
    return (
        effect.kind == "mean"
        and sum(p.size for p in effect.parameters) == trials.entries
        and not places(effect).any()
        and effect.rewrites.keys() == trials.effect.rewrites.keys()
    )
