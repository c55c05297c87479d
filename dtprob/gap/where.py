"""Where the gap lies: over the model's sites and over the data's coordinates, each map with family-wise control.

Sites are the model's deterministic ones and the spreads of what is observed. One gradient per bootstrap replicate serves
all families of all sites.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from dtprob.gap.bootstrap import Replicates
from dtprob.gap.curves import curves
from dtprob.gap.families import Site, deterministic, families, observed, shifted
from dtprob.gap.family_test import CHANCE, FamilyTest, family_test
from dtprob.gap.fit import Fit
from dtprob.gap.problem import Problem
from dtprob.gap.projection import Projection
from dtprob.gap.suspects import Suspect, suspects
from dtprob.gap.tails import family_wise, gamma_tail

_SURE = 0.005
"""Probability below which a site is surely wrong."""


@dataclass(frozen=True)
class SiteFinding:
    """Evidence that a site's values are wrong.

    Attributes:
        site: its name.
        family: what is added ("additive", "relative", "conjugate", "spread", ...) and how it varies.
        p_value: family-wise over all sites and families.
        gain: nats that moving the site along its steepest direction would gain, nuisances refitted to first order.
        last: whether it is the spread of an observation where another site is surely wrong: a wrong mean spreads too.
    """

    site: str
    family: str
    p_value: float
    gain: float
    last: bool = False


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
    """Maps of the gap at one fit; the suspects come in order of falling evidence.

    `entries` holds, for sites of several axes, the nats above chance that a factor of its own would gain at each entry.
    """

    sites: tuple[SiteFinding, ...]
    coordinates: tuple[CoordinateFinding, ...]
    axes: dict[str, np.ndarray]
    site_p_value: float
    suspects: tuple[Suspect, ...] = ()
    entries: Mapping[str, np.ndarray] = MappingProxyType({})


def locate(problem: Problem, fitted: Fit, projection: Projection, drawn: Replicates) -> Location:
    """Test every site family and every block of coordinates at a fit."""
    at = problem.compiled.sites(projection.origin)  # what was fitted to these data would agree with them
    axes = {name: site.axes for name, site in problem.declaration.sites.items()}
    found = [deterministic(n, axes[n], np.asarray(at[n]), np.asarray(g)) for n, g in drawn.gradients.items()]
    found += observed(problem, np.concatenate([drawn.observed[None], drawn.projected]))
    along = functools.cache(functools.partial(curves, problem))  # sites share their axes
    tested = [[family_test(*family) for family in families(along, site)] for site in found]
    null = [test.null for tests in tested for test in tests]
    smallest = np.stack(null, axis=1).min(axis=1) if null else np.ones(1)
    findings = [
        _finding(problem, fitted, projection, drawn, site=site, tests=tests, smallest=smallest)
        for site, tests in zip(found, tested, strict=True)
    ]
    blocks, maps = _coordinates(problem, drawn.observed, drawn.projected)
    ordered = tuple(sorted(_spreads_last(findings), key=lambda f: (f.last, f.p_value, -f.gain)))
    sure = {f.site for f in findings if f.p_value <= _SURE}
    named = [
        s
        for site, tests in zip(found, tested, strict=True)
        if site.name in sure
        for s in suspects(site, tests)
    ]
    suspected = tuple(sorted(named, key=lambda s: -s.evidence))
    entries = {site.name: e for site, tests in zip(found, tested, strict=True) for e in _entries(site, tests)}
    return Location(ordered, blocks, maps, min((f.p_value for f in ordered), default=1.0), suspected, entries)


def _entries(site: Site, tests: Sequence[FamilyTest]) -> Iterator[np.ndarray]:
    """The map over the entries of a site of several axes."""
    wide = tuple(i for i, n in enumerate(site.value.shape) if n > 1)
    for test in tests if len(wide) > 1 else ():
        if (
            test.family.kind == "relative"
            and test.family.pattern.kept == wide
            and test.family.pattern.curves is None
        ):
            seen = test.variance > 1e-12 * max(float(test.variance.max(initial=0.0)), 1e-300)
            gain = np.where(seen, 0.5 * (test.first[0] ** 2 / np.where(seen, test.variance, 1.0) - 1), 0.0)
            yield gain.reshape(*site.value.shape, -1).sum(-1)


def _spreads_last(findings: Sequence[SiteFinding]) -> list[SiteFinding]:
    spread = [f.family.startswith("spread") for f in findings]
    sure = any(f.p_value <= _SURE and not s for f, s in zip(findings, spread, strict=True))
    return [replace(f, last=sure and s) for f, s in zip(findings, spread, strict=True)]


def _finding(
    problem: Problem,
    fitted: Fit,
    projection: Projection,
    drawn: Replicates,
    *,
    site: Site,
    tests: Sequence[FamilyTest],
    smallest: np.ndarray,
) -> SiteFinding:
    """The family of a site with the smallest p-value, with the gain along its steepest direction."""
    best = min(tests, key=lambda test: (test.p_value, -float((test.first[0] ** 2).sum())))
    steps = np.stack([best.family.step(score, best.variance, site.value) for score in best.first])
    shifts = projection.rows(shifted(problem, fitted.x, site, steps))
    rows = np.concatenate([drawn.observed[None], drawn.projected[:CHANCE]])
    slope = np.einsum("ncm,ncm->n", shifts, rows)
    curvature = np.einsum("ncm,ncm->n", shifts, shifts)
    gain = np.where(curvature > 0, 0.5 * slope**2 / np.maximum(curvature, 1e-300), 0.0)
    net = max(float(gain[0] - gain[1:].mean()), 0.0)
    p_value = float(family_wise(np.array([best.p_value]), smallest)[0])
    return SiteFinding(site.name, best.family.label, p_value, net)


def _coordinates(
    problem: Problem, observed: np.ndarray, null: np.ndarray
) -> tuple[tuple[CoordinateFinding, ...], dict[str, np.ndarray]]:
    """Energy of the whitened residuals over dyadic blocks of every axis, against its bootstrap distribution."""
    blocks: list[tuple[str, int, int]] = []
    p, excess, maps = [], [], {}
    located = problem.rows.by_cluster(problem.rows.located) == 1
    for axis, position in problem.rows.coordinates.items():
        index = np.where(located, problem.rows.by_cluster(position), -1)
        size = int(index.max()) + 1
        if size < 2:
            continue
        energy = np.stack([_energy(rows, index, size) for rows in (observed, *null)])
        maps[axis] = (energy[0] - energy[1:].mean(0)) / np.maximum(energy[1:].std(0), 1e-12)
        cumulative = np.concatenate([np.zeros((len(energy), 1)), np.cumsum(energy, axis=1)], axis=1)
        low, high = np.array(list(_windows(size, ordered=axis != problem.declaration.cluster))).T
        inside = cumulative[:, high + 1] - cumulative[:, low]
        blocks += ((axis, *window) for window in zip(low.tolist(), high.tolist(), strict=True))
        p.append(gamma_tail(inside, inside[1:].mean(0), inside[1:].var(0))[0])
        excess.append((inside[0] - inside[1:].mean(0)) / 2)
    if not blocks:
        return (), maps
    tails = np.concatenate(p, axis=1)
    adjusted = family_wise(tails[0], tails[1:].min(axis=1))
    found = [
        CoordinateFinding(*block, p_value=float(adjusted[i]), excess=float(e))
        for i, (block, e) in enumerate(zip(blocks, np.concatenate(excess), strict=True))
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
