"""How sites may be wrong: along axes, over the data's columns and over what the model computes, made once for all tests."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dtprob.gap.fitting.bootstrap import Replicates, normal_like
from dtprob.gap.model.conditioned import conditioned
from dtprob.gap.model.inline import unnamed
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation.likelihoods import is_discrete
from dtprob.gap.where.along import curves
from dtprob.gap.where.data_columns import all_columns, whole_columns
from dtprob.gap.where.families import Along, Over
from dtprob.gap.where.quantities import Quantity, cells, groups, of_each, quantity, together
from dtprob.gap.where.repeats import repeats
from dtprob.gap.where.site_finding import SiteFinding

type Columns = dict[str, tuple[tuple[str, ...], np.ndarray]]
"""Axes and values of columns, by name."""


class Ways(NamedTuple):
    """How sites may be wrong, whatever the replicates.

    Attributes:
        values: of the sites.
        along: curves along their axes.
        over: curves over quantities.
        unnamed: observations whose values no site stands for.
        normal: normal rows and site gradients, of the replicates' covariance, of outcomes and counts; else None.
        repeated: observations of which one value is read too often.
    """

    values: Mapping[str, np.ndarray]
    along: Along
    over: Over
    unnamed: frozenset[str]
    normal: tuple[np.ndarray, Mapping[str, np.ndarray]] | None
    repeated: Sequence[SiteFinding]


def ways(problem: Problem, x: np.ndarray, drawn: Replicates) -> Ways:
    """What all tests of sites share, made once.

    Args:
        problem: the model on its data.
        x: the flat vector of the fit, with what the prior knows at its centre; see `Projection.origin`.
        drawn: replicates at the fit.
    """
    at = problem.compiled.sites(x)
    values = {n: np.broadcast_to(np.asarray(at[n]), grown.shape) for n, grown in problem.float_sites.items()}
    along = functools.cache(functools.partial(curves, problem))  # sites share their axes
    knowing = conditioned(problem, x)
    apart = {n: value for n, value in values.items() if n not in knowing}
    columns = _columns(problem)
    over = [(q, tuple(q.curves())) for q in _quantities(problem, apart, columns)]
    over += [
        (q, (found,))
        for axes, shape, given in _observed(problem)
        for q, found in together(axes, shape, given)
    ]
    over += [(q, (found,)) for n, (axes, value) in columns.items() for q, found in of_each(n, axes, value)]
    discrete = any(is_discrete(family) for family in problem.families.values())
    normal = normal_like(drawn) if discrete else None
    return Ways(values, along, over, unnamed(problem, x), normal, tuple(repeats(problem, x)))


def _quantities(problem: Problem, values: Mapping[str, np.ndarray], columns: Columns) -> Iterator[Quantity]:
    """What the model computes and the data tell along several axes: a perturbation may vary over it."""
    computed = {name: (problem.declaration.sites[name].axes, value) for name, value in values.items()}
    for name, (axes, value) in (columns | computed).items():
        if (found := quantity(name, axes, value)) is not None:
            yield replace(found, computed=name not in columns)
    for name, (axes, value) in columns.items():
        yield from groups(name, axes, value)
    for axes, shape, given in _observed(problem):
        yield from cells(axes, shape, given)


def _columns(problem: Problem) -> Columns:
    """Axes and values of the columns of the data along several axes."""
    return {
        name: (site.axes, column)
        for site in problem.declaration.observed.values()
        for name, column in whole_columns(problem, site).items()
    }


def _observed(problem: Problem) -> Iterator[tuple[tuple[str, ...], tuple[int, ...], dict[str, np.ndarray]]]:
    """Axes and shape of what is observed along several axes, each once, with the columns of the data there."""
    seen = {(site.axes, site.shape): site for site in problem.declaration.observed.values()}
    for (axes, shape), site in seen.items():
        if len(shape) > 1:
            yield axes, shape, all_columns(problem, site)
