"""What is wrong with a base model or its data before any effect is tried."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import compress
from typing import Any, Final

import numpy as np
from numpyro.distributions import constraints

from dtprob.errors import InputError
from dtprob.gap.fitting.active import Active, activate, basis
from dtprob.gap.fitting.at_end import at_end
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.projection import project
from dtprob.gap.fitting.states import are_states
from dtprob.gap.model.inline import unnamed
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation import whiten
from dtprob.gap.vocabulary import UNSEEN
from dtprob.models.declaration import base_constraint

_VANISHED: Final = 1e-14
"""Share of the usual observed value below which a spread is rounding."""
_MISFIT: Final = 30.0
"""Residuals as many times the spread that the model allows are no fit."""
_SINGULAR: Final = 1e-8
"""Information along a direction, as a share of that of its parameters alone, below which data do not determine it."""
_TAKES_PART: Final = 0.2
"""Weight of a parameter in a direction from which on it is named."""
_LOPSIDED: Final = 16
_MANY: Final = 50_000
"""Times the data's rows, and rows, from which it is said what it costs that clusters are as long as the longest."""
_CONTRADICTED: Final = 3.5
"""Standard deviations from the middle of a prior from which a parameter is told, where no draw of the prior reaches it."""
_SHOWN: Final = 4
_STEP: Final = 0.01
"""Of a coordinate, to see what it acts on."""


def broken(problem: Problem, starts: Sequence[np.ndarray]) -> InputError:
    """Why a model has no finite likelihood: the first thing that is not finite, data before sites before observations.

    Args:
        problem: the model on its data.
        starts: flat vectors that were tried.
    """
    what = f"base model {problem.declaration.name}"
    for name, site in problem.declaration.observed.items():
        bad = ~np.isfinite(np.asarray(problem.observed.values[name]))
        if bad.any():
            argument = site.argument or name
            return InputError(
                f"data {argument}",
                "finite values",
                told_bad(bad),
                "Remove these rows or mark them as missing",
            )
    values: Mapping[str, Any] = problem.compiled.sites(starts[0])
    for name in problem.declaration.deterministic:
        bad = ~np.isfinite(np.asarray(values[name]))
        if bad.any():
            return InputError(
                f"{what}, site {name}",
                "finite values at the centre of the prior",
                told_bad(bad),
                "Check the units of the data and the priors of what enters this site",
            )
    return _impossible(problem, starts) or InputError(
        what,
        "a finite likelihood somewhere under its prior",
        f"none from any of {len(starts)} starts, though all its sites are finite",
        f"Check that {', '.join(problem.declaration.observed)} can take the values of the data, in the same units",
    )


def check_possible(problem: Problem, fitted: Fit) -> None:
    """Refuse data that cannot be under the fitted base model, as a count where it expects none.

    Raises:
        InputError: an observed value is impossible; the first is named.
    """
    error = _impossible(problem, [fitted.x])
    if error is not None:
        raise error


def _impossible(problem: Problem, points: Sequence[np.ndarray]) -> InputError | None:
    """What is wrong with the first observed values that can be at none of the points; nothing where all can be."""
    at = [problem.compiled.observations(x) for x in points]
    for name, values in problem.observed.values.items():
        seen = np.asarray(values)
        bad = np.all([np.asarray(whiten.impossible(one[name], values)) for one in at], axis=0)
        if bad.any():
            first = tuple(int(k) for k in np.argwhere(bad)[0])
            more = f" and {bad.sum() - 1} more" if bad.sum() > 1 else ""
            argument = problem.declaration.observed[name].argument or name
            given = {
                n: np.broadcast_to(np.asarray(v), bad.shape)[first]
                for n, v in at[0][name].parameters.items()
                if n != "mask" and np.ndim(v) == bad.ndim
            }
            law = ", ".join(f"{n} {v:.3g}" for n, v in given.items())
            return InputError(
                f"data {argument}",
                f"values that can be under the base model {problem.declaration.name}",
                f"{seen[first]} at [{', '.join(map(str, first))}] where it has {at[0][name].family} of {law}{more}",
                "Leave such rows out, or let the model allow for them by a small rate or chance",
            )
    return None


def check_noise(problem: Problem, fitted: Fit) -> None:
    """Refuse data that a model meets exactly, as it does those of a stuck sensor: nothing is left to judge a gap by.

    Raises:
        InputError: the spread of an observed site has vanished in the fit.
    """
    for name, observed in problem.compiled.observations(fitted.x).items():
        if not {"loc", "scale"} <= observed.parameters.keys() or observed.family == "LogNormal":
            continue  # of another unit than the values
        loc, scale = (np.asarray(observed.parameters[n]) for n in ("loc", "scale"))
        seen = np.asarray(problem.observed.values[name])
        rounding = _VANISHED * (float(np.median(np.abs(seen))) or 1.0)  # what is 0 throughout has no unit
        if np.all(scale < rounding) and np.median(np.abs(seen - loc)) < 100 * rounding:
            raise InputError(
                f"data {problem.declaration.observed[name].argument or name}",
                f"values that scatter about the model {problem.declaration.name}",
                "values that it meets exactly, with no noise left",
                "Leave out what a stuck sensor gives, or observe what the values are rounded from",
            )


def told_bad(bad: np.ndarray) -> str:
    """How many entries are not as they should be, and the first of them, in words."""
    first = ", ".join(str(int(k)) for k in np.argwhere(bad)[0])
    return f"{int(bad.sum())} of {bad.size} that are not, the first at [{first}]"


def notes(problem: Problem, fitted: Fit) -> tuple[str, ...]:
    """What a reader should know of the fit of the base model, one sentence each; nothing where all is well."""
    found = [] if fitted.converged else ["the fit of the base model had not converged"]
    if problem.declaration.factors:
        names = ", ".join(problem.declaration.factors)
        remedy = "if it is data, observe a distribution, say LeftCensoredDistribution"
        found.append(
            f"what numpyro.factor adds ({names}) counts as a prior, and no gap is looked for in it; {remedy}"
        )
    found += [f"{name} is at the end of its prior" for name in at_end(problem, fitted)]
    found += _contradicted(problem, fitted)
    found += _inline(problem, fitted)
    return (*found, *_too_large(problem, fitted), *_misfit(problem, fitted), *_undetermined(problem, fitted))


def _inline(problem: Problem, fitted: Fit) -> list[str]:
    """Observations whose values no site moves, though the model names some."""
    names = sorted(unnamed(problem, fitted.x, np.inf)) if problem.float_sites else []
    remedy = "where one is named, let the model go on with what numpyro.deterministic returns"
    return [f"no site that the model names moves the values of {_listed(names)}: {remedy}"] if names else []


def _contradicted(problem: Problem, fitted: Fit) -> list[str]:
    """Parameters that the data put where their prior hardly ever is: what explains a gap may have hidden in one.

    Of those with bounds only what lies far above a lower one: near a bound, as a spread near 0, nothing is contradicted.
    """
    if problem.known:
        return []
    active = activate(problem, fitted.effects)
    asked, index = ~are_states(problem, active), active.global_index
    spread = problem.prior_spread
    away = np.abs(fitted.x - spread.middle) / np.maximum(spread.deviation, 1e-300)
    below, beyond = (
        (away > _CONTRADICTED) & far for far in (fitted.x < spread.least, fitted.x > spread.largest)
    )
    for block in (b for b in active.blocks if not b.local and b.owner is None):
        kind = base_constraint(problem.declaration.sites[block.name].support)
        if kind is constraints.real:
            beyond[block.index] |= below[block.index]
        elif not isinstance(kind, type(constraints.positive)):
            beyond[block.index] = False
    told = [(owner, i) for owner, i, is_asked in zip(_names(active), index, asked, strict=True) if is_asked]
    remedy = "its prior is wrong, or it takes up what is a gap"
    found = [
        f"the data put {owner} {away[i]:.1f} standard deviations from the middle of its prior: {remedy}"
        for owner, i in told
        if beyond[i]
    ]
    return found[:_SHOWN]


def _names(active: Active) -> list[str]:
    """What the free coordinates that clusters share are called."""
    blocks = [b for b in active.blocks if not b.local]
    return [b.name if b.size == 1 else f"{b.name}[{j}]" for b in blocks for j in range(b.size)]


def lopsided(problem: Problem) -> list[str]:
    """A note where one cluster is so long that holding all as long as it costs much; nothing where none is."""
    rows = problem.rows
    times = rows.gather.size / len(rows.ids)
    if times < _LOPSIDED or rows.gather.size < _MANY:
        return []
    values = np.bincount(rows.ids[rows.located == 1], minlength=problem.n_cluster)
    longest = (
        f"the longest of {problem.n_cluster} clusters by {problem.cluster_name!r} has {values.max()} values"
    )
    others = f"half of them have at most {np.median(values):.0f}"
    costs = f"each costs the time and memory of the longest, {times:.0f} times those of the data"
    return [
        f"{longest}, {others}: {costs}; if its parts are independent of one another, let each be a cluster"
    ]


def idle(absorbed_by: Sequence[str | None]) -> list[str]:
    """A note where no candidate does anything, from what hides each of them."""
    is_idle = bool(absorbed_by) and set(absorbed_by) == {UNSEEN}
    return ["nothing observed depends on any of the effects"] if is_idle else []


def _too_large(problem: Problem, fitted: Fit) -> list[str]:
    """Sites that are not looked at, since they have many more entries than the data."""
    sites = problem.compiled.sites(fitted.x)
    moved = [n for n in problem.declaration.deterministic if np.issubdtype(sites[n].dtype, np.inexact)]
    left = [n for n in moved if sites[n].size and n not in problem.float_sites]
    return [f"no gap is looked for at {', '.join(left)}: too many entries beside the data"] if left else []


def _misfit(problem: Problem, fitted: Fit) -> list[str]:
    residual = np.asarray(problem.compiled.residual(fitted.x))
    located = problem.rows.is_location
    size = float(np.sqrt(np.mean(residual[located] ** 2))) if located.any() else 0.0
    if size < _MISFIT:
        return []
    names = ", ".join(problem.declaration.observed)
    left = f"what it leaves of {names} is {size:.2g} times the spread that it allows"
    remedy = "check the units of the data and the prior of the noise before believing any cause"
    return [f"the base model does not fit at all: {left}; {remedy}"]


def _undetermined(problem: Problem, fitted: Fit) -> list[str]:
    """Parameters that the data do not determine: too few clusters, no information, or only a combination of them."""
    active = activate(problem, fitted.effects)
    asked = ~are_states(problem, active)
    owners = list(compress(_names(active), asked))
    if not owners:
        return []
    found = []
    if problem.n_cluster < len(owners):
        found.append(
            f"{problem.n_cluster} clusters for {len(owners)} fitted parameters: what is held out tells little of how far"
            " a cause closes the gap"
        )
    columns = np.asarray(
        problem.compiled.linearised(fitted.x, basis(problem, active)[: len(asked)][asked])[1]
    )
    reduced = project(problem, fitted).without_own(columns)  # what acts through the clusters' own is seen too
    total = np.einsum("cmi,cmi->i", columns, columns)
    seen = total > 0
    told = seen.copy()
    told[~seen] = _spreads_levels(problem, fitted.x, active.global_index[asked][~seen])
    if not told.all():
        found.append(
            f"the data tell nothing about {_listed([o for o, s in zip(owners, told, strict=True) if not s])}"
        )
    information = np.einsum("cmi,cmj->ij", columns, reduced)[np.ix_(seen, seen)]
    size = np.sqrt(total[seen])
    values, vectors = np.linalg.eigh((information + information.T) / 2 / np.outer(size, size))
    known = [owner for owner, s in zip(owners, seen, strict=True) if s]
    weak = np.abs(vectors[:, values < _SINGULAR]).max(axis=1, initial=0.0)
    absorbed = [owner for owner, weight in zip(known, weak, strict=True) if weight > _TAKES_PART]
    ends = at_end(problem, fitted)  # there the data hardly move anything
    if absorbed and not set(absorbed) & set(ends):
        found.append(
            f"the data determine only a combination of {_listed(absorbed)}; their priors tell the rest"
        )
    return found


def _spreads_levels(problem: Problem, x: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Which coordinates act on what clusters have of their own, as a spread of levels does: these tell of them."""
    before, found = problem.compiled.evaluate(x)[2], []
    for i in index:
        moved = x.copy()
        moved[i] += _STEP
        found.append(bool((problem.compiled.evaluate(moved)[2] != before).any()))
    return np.array(found, bool)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
