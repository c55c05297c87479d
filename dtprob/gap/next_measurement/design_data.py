"""Designs as data of the model: what rival fits predict at clusters that could be measured, or measured again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dtprob.errors import InputError
from dtprob.gap.diagnosis import Cause
from dtprob.gap.evidence import Evidence
from dtprob.gap.fitting.active import activate, basis, own_basis
from dtprob.gap.fitting.fit import Fit, fit
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.next_measurement.design import Design, Prediction, Ranked, joined, rank, recommend
from dtprob.gap.observation import whiten
from dtprob.gap.which.trials import Start
from dtprob.models.arguments import Data, as_arrays
from dtprob.models.execution import trace_model

_SHOWN: Final = 5
"""Designs that a report lists."""
_LOOSE: Final = 1e-6
"""Prior precision of a cluster's own coordinate, at least, as a share of what its rows tell of it."""
_MOST_ENTRIES: Final = 2e7
"""Of the tangents of all clusters' fields together."""
_AGAIN: Final = "again"
"""Name of the data that are there, measured once more."""


def next_measurement(
    evidence: Evidence, causes: Sequence[Cause], designs: Mapping[str, Data]
) -> dict[str, Any] | None:
    """What to measure so that the explanations that are left can be told apart; None where nothing was found.

    Where one alone is left, which the data do not confirm, its rival is the twin as it is.

    Args:
        evidence: of the diagnosis.
        causes: what was found; the first one's class is to be split.
        designs: arguments of the model for measurements that could be made, by name; each cluster of each is a candidate,
            beside those that are there, measured again. Observed values in them are not looked at.

    Returns:
        For report.json: the classes, the recommended designs with their repeats and what they bring, whether they are all
        that is there, as nothing less decides for less, what repeating that costs, and the best single designs in order.
    """
    if not causes:
        return None
    found = {**evidence.explanations, (): Start(evidence.problem, evidence.base)}
    alike = causes[0].alias_class
    rivals = alike if len(alike) > 1 else (*alike, ())
    here = evidence.last.problem.with_live([name for names in rivals for name in names])
    fits = [_moved(here, found[names]) for names in rivals]
    again = designs_of(here, here, fits, _AGAIN)
    candidates = list(again)
    for name, data in designs.items():
        candidates += designs_of(_problem_at(here, data), here, fits, name)
    told = everything(again)
    whole = told if told is not None and told.resolves else None
    best = cheapest(candidates, whole)
    return {
        "split": [list(names) for names in rivals],
        "design": dict(best.where),
        "repeats": best.repeats,
        "gain_nats": best.nats,
        "resolves": best.resolves,
        "everything": best is whole,
        "cost": best.cost,
        **({} if told is None else {"cost_of_all_again": None if whole is None else whole.cost}),
        "ranking": [_line(one) for one in rank(candidates)[:_SHOWN]],
    }


def everything(again: Sequence[Design]) -> Ranked | None:
    """All that is there, made again as often as decides; None where there are too many fields to hold.

    Args:
        again: the clusters, each measured again.
    """
    first = again[0].predictions
    rows, fields = len(first[0].mean), max(0 if p.own is None else p.own.shape[1] for p in first)
    if len(again) ** 2 * rows * fields > _MOST_ENTRIES:
        return None
    return rank([joined(again)])[0]


def cheapest(candidates: Sequence[Design], whole: Ranked | None) -> Ranked:
    """The plan of a few designs, or the whole where no such plan costs less.

    Args:
        candidates: the designs.
        whole: everything again, if that decides.
    """
    few = recommend(candidates)
    return few if whole is None or (few.resolves and few.cost <= whole.cost) else whole


def _moved(here: Problem, at: Start) -> Fit:
    """A fit in the coordinates of another problem on the same data."""
    x = here.translate(at.fitted.x, at.problem)
    return fit(here, x, at.fitted.effects, spread=at.fitted.spread)


def designs_of(there: Problem, here: Problem, fits: Sequence[Fit], name: str) -> list[Design]:
    """Each cluster of a problem as a design of cost 1.

    Args:
        there: the model on the data of the designs, with the fits' effects live.
        here: the model on the data that were fitted.
        fits: of the rivals.
        name: of the data.
    """
    moved = [replace(fitted, x=there.translate(fitted.x, here)) for fitted in fits]
    origin = there.compiled.observations(moved[0].x)
    columns = [_columns(there, fitted) for fitted in moved]
    _check_parameters(there, here, fits, name)
    whitened = _whitening(there, moved[0].x, columns[0].own)
    rivals = [
        (
            whitened(_mean(there, fitted, origin, of)[..., None])[..., 0],
            whitened(of.shared),
            whitened(of.field) if of.field.shape[-1] else None,
        )
        for fitted, of in zip(moved, columns, strict=True)
    ]
    designs = []
    for cluster in range(there.n_cluster):
        predictions = tuple(
            Prediction(mean[cluster], shared[cluster], f.covariance, None if own is None else own[cluster])
            for (mean, shared, own), f in zip(rivals, fits, strict=True)
        )
        where = {there.cluster_name: _label(there, cluster)}
        designs.append(Design(where if name == _AGAIN else {"design": name, **where}, 1.0, predictions))
    return designs


def _problem_at(here: Problem, data: Data) -> Problem:
    """The same model and live effects on other data."""
    named = here.cluster_name in data or here.cluster_name in {
        axis for site in here.declaration.observed.values() for axis in site.axes
    }
    data = _with_values(here, data)
    there = Problem(here.model, data, here.effects, here.cluster_name if named else None, decentre=False)
    there.known = here.known
    return there.with_live([effect.name for effect in here.live])


def _with_values(here: Problem, data: Data) -> Data:
    """Data of what has not been measured yet, with values drawn for what would be observed: nothing looks at them."""
    sites = {name: site.argument for name, site in here.declaration.observed.items()}
    missing = {n: a for n, a in sites.items() if a is not None and data.get(a) is None}
    if not missing:
        return data
    given = {**as_arrays(data), **dict.fromkeys(missing.values())}
    trace = trace_model(here.model, given, jax.random.key(0))
    return {**given, **{argument: trace[name]["value"] for name, argument in missing.items()}}


def _check_parameters(there: Problem, here: Problem, fits: Sequence[Fit], name: str) -> None:
    """Designs must have the parameters that were fitted."""
    for fitted in fits:
        own, expected = (
            {b.name: b.size for b in activate(problem, fitted.effects).blocks if not b.local}
            for problem in (there, here)
        )
        if own != expected:
            fitted_ones = f"the {sum(expected.values())} shared parameters of the fit"
            remedy = "Give designs of the same objects, antennas and devices"
            raise InputError(f"design {name}", fitted_ones, str(sum(own.values())), remedy)


def _label(problem: Problem, cluster: int) -> Any:
    """What the user calls a cluster: the entry of its column, or its number.

    Where all entries differ, clusters are in their order.
    """
    column = np.asarray(problem.data.get(problem.cluster_name, 0))
    names = np.unique(column)
    if column.ndim != 1 or len(names) != problem.n_cluster:
        return cluster
    return (column if len(names) == len(column) else names)[cluster].item()


def _mean(
    problem: Problem, fitted: Fit, origin: Mapping[str, whiten.Observation], columns: _Columns
) -> Float[np.ndarray, "cluster row"]:
    """Whitened rows that a fit predicts, from an origin, with clusters' own coordinates at the centre of their prior.

    What the data so far tell of these is nothing that new rows have: they are drawn anew.
    """
    rows = _shift(problem, origin, problem.compiled.observations(fitted.x))
    if not columns.local.shape[-1]:
        return rows
    return rows - np.einsum("cml,cl->cm", columns.local, project(problem, fitted).own.deviation)


def _shift(
    problem: Problem, origin: Mapping[str, whiten.Observation], other: Mapping[str, whiten.Observation]
) -> Float[np.ndarray, "cluster row"]:
    """Whitened difference of the observed distributions' parameters."""
    rows = {}
    for name, observed in origin.items():
        change = {n: other[name].parameters[n] - value for n, value in observed.parameters.items()}
        rows[name] = whiten.shift(observed, change)
    return np.asarray(problem.rows.stack(rows))


class _Columns(NamedTuple):
    """Whitened tangents (cluster, row, coordinate) of a fit's coordinates.

    Attributes:
        shared: of the global ones.
        local: of those that clusters have of their own.
        is_field: which of these are a random field's.
        deviation: standard deviations of the fields' ones.
    """

    shared: np.ndarray
    local: np.ndarray
    is_field: np.ndarray
    deviation: np.ndarray

    @property
    def own(self) -> np.ndarray:
        """Of the base model's own ones, which all rivals have."""
        return self.local[..., ~self.is_field]

    @property
    def field(self) -> np.ndarray:
        """Of the fields' ones, of unit variance."""
        return self.local[..., self.is_field] * self.deviation


def _columns(problem: Problem, fitted: Fit) -> _Columns:
    active = activate(problem, fitted.effects, spread=fitted.spread)
    columns = np.asarray(problem.compiled.linearised(fitted.x, basis(problem, active))[1])
    n = len(active.global_index)
    owners = [b.owner for b in active.blocks if b.local for _ in range(b.size)]
    deviation = np.array([active.spread[owner] for owner in owners if owner is not None])
    is_field = np.array([owner is not None for owner in owners], bool)
    return _Columns(columns[..., :n], columns[..., n:], is_field, deviation)


def _whitening(
    problem: Problem, x: np.ndarray, own: Float[np.ndarray, "cluster row local"]
) -> Callable[[np.ndarray], np.ndarray]:
    """What makes rows (cluster, row, any) independent once clusters' own coordinates are integrated over their prior.

    Of the base model's only, which all rivals have: a field is one rival's, and part of what it predicts.
    """
    active = activate(problem)
    directions = own_basis(problem, active)
    if not len(directions):
        return lambda rows: rows
    curvature = problem.compiled.prior(x, directions)[1]
    precision = np.stack([row[active.local_index[:, j]] for j, row in enumerate(curvature)], axis=-1)
    told = np.einsum("cml,cml->cl", own, own)
    scaled = own / np.sqrt(np.maximum(precision, _LOOSE * np.maximum(told, 1e-300)))[:, None, :]
    left, size, _ = np.linalg.svd(scaled, full_matrices=False)
    shrink = 1 - 1 / np.sqrt(1 + size**2)
    return lambda rows: rows - np.einsum("cmk,ck,cnk,cnj->cmj", left, shrink, left, rows, optimize=True)


def _line(one: Ranked) -> dict[str, Any]:
    return {
        "design": dict(one.where),
        "repeats": one.repeats,
        "gain_nats": one.nats,
        "cost": one.cost,
        "resolves": one.resolves,
    }
