"""Where the gap lies: over the model's sites and over the data's coordinates, each map with family-wise control.

Sites are the model's deterministic ones and the spreads of what is observed. One gradient per bootstrap replicate serves
all families of all sites.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from dtprob.gap.fitting.bootstrap import Replicates, more
from dtprob.gap.fitting.fit import Fit
from dtprob.gap.fitting.projection import Projection
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.where.coordinates import CoordinateFinding, scan_coordinates
from dtprob.gap.where.differences import Differences, differences
from dtprob.gap.where.families import Family, Site, deterministic, families, observed, shifted
from dtprob.gap.where.family_test import CHANCE, FamilyTest, family_test
from dtprob.gap.where.far_readings import far_readings, held, naming
from dtprob.gap.where.foremost import foremost, names_of_entries
from dtprob.gap.where.gains import gains
from dtprob.gap.where.in_all import InAll
from dtprob.gap.where.moments import further_moments
from dtprob.gap.where.site_finding import SURE, SiteFinding, rank, shadows_last
from dtprob.gap.where.suspects import Suspect, plainest, suspects
from dtprob.gap.where.ways import Ways, ways

_ALL_SPREAD: Final = 0.999
"""Share of what a site moves that lies in spreads where it moves nothing else."""
_FOLLOWS: Final = 10
"""Readings for each weight of a family, below which it follows noise that is larger at some of them."""
_MORE: Final = 400
"""Replicates of a second look at the sites, at least; a third one takes all that the settings allow."""
_OPEN_AT_FIRST: Final = (1e-9, 0.5)
"""Between these, a first look does not tell on which side of the level a gap lies; of outcomes and counts not below."""
_OPEN_WHERE_SHOWN: Final = (1e-6, 0.1)
"""The same where the effects' scores show the gap, and the sites say mostly where it lies."""
_OPEN_AT_SECOND: Final = (0.01, 10.0)
"""Multiples of the level between which a second look does not tell it either."""
_OPEN_OF_OUTCOMES: Final = 1e-6
"""The lower one of outcomes and counts: hundreds of replicates still understate how far rare ones stray."""


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
    differences: tuple[Differences, ...] = ()


NOWHERE: Final = Location((), (), {}, 1.0)
"""No map: nothing was looked at."""


def locate(
    problem: Problem,
    fitted: Fit,
    projection: Projection,
    drawn: Replicates,
    settings: Settings,
    *,
    shown: bool = False,
) -> Location:
    """Test every site family and every block of coordinates at a fit.

    Args:
        problem: the model and candidates on their data.
        fitted: the fit.
        projection: of rows there.
        drawn: the data and replicates there.
        settings: how many more replicates decide at which level.
        shown: whether the effects' scores show a gap already.
    """
    blocks, maps = scan_coordinates(problem, drawn)
    # at the origin: what was fitted to these data would agree with them
    looked_for, looked = ways(problem, projection.origin, drawn), drawn
    seen = _test_sites(problem, fitted, projection, looked, looked_for)
    for times, (low, high) in _further_looks(
        drawn, settings, shown=shown, discrete=looked_for.normal is not None
    ):
        if low < seen.p_value < high:
            looked = more(drawn, times)
            seen = _test_sites(problem, fitted, projection, looked, looked_for)
    if far := far_readings(looked, seen.of_moments):
        seen = _test_sites(problem, fitted, projection, looked, looked_for, at_sites=held(looked, far))
        seen = seen._replace(of_moments=naming(seen.of_moments, far))
    sure = {f.site for f in seen.of_sites if f.p_value <= SURE}
    named = [s for site, tests in seen.tested if site.name in sure for s in suspects(site, tests)]
    suspected = tuple(sorted(named, key=lambda s: -s.steady))
    entries = {site.name: e for site, tests in seen.tested for e in _entries(site, tests)}
    towards_data = {name: -i for i, name in enumerate(problem.declaration.sites)}
    findings = shadows_last(seen.findings, _energy(problem, drawn))
    ordered = tuple(sorted(findings, key=lambda f: (*rank(f), towards_data[f.site])))
    strays = differences(problem, drawn)
    return Location(ordered, blocks, maps, seen.p_value, suspected, entries, strays)


def _further_looks(
    drawn: Replicates, settings: Settings, *, shown: bool, discrete: bool
) -> Iterator[tuple[int, tuple[float, float]]]:
    """How many times more replicates another look takes, and between which p-values of the look before it is taken."""
    most = drawn.most(settings.site_times)
    second = min(math.ceil(_MORE / max(drawn.at_sites, 1)), most)
    if second > 1:
        low, high = _OPEN_WHERE_SHOWN if shown else _OPEN_AT_FIRST
        yield second, (0.0 if discrete else low, high)
    if most > second:
        low, high = _OPEN_AT_SECOND
        yield most, ((_OPEN_OF_OUTCOMES if discrete else low) * settings.level / 2, high * settings.level / 2)


class _Tested(NamedTuple):
    """Every site with the tests of its families, what they say in the same order, and what further moments say."""

    tested: list[tuple[Site, list[FamilyTest]]]
    of_sites: list[SiteFinding]
    of_moments: list[SiteFinding]

    @property
    def findings(self) -> list[SiteFinding]:
        """All of them."""
        return self.of_sites + self.of_moments

    @property
    def p_value(self) -> float:
        """Family-wise over all sites."""
        return min((f.p_value for f in self.findings), default=1.0)


def _test_sites(
    problem: Problem,
    fitted: Fit,
    projection: Projection,
    drawn: Replicates,
    looked_for: Ways,
    *,
    at_sites: Replicates | None = None,
) -> _Tested:
    """Every family of every site, and further moments; sites with far readings held where `at_sites` has these."""
    axes = {name: site.axes for name, site in problem.declaration.sites.items()}
    told = drawn if at_sites is None else at_sites
    rows, gradients = told.rows, {n: np.asarray(g) for n, g in told.gradients.items()}
    if looked_for.normal is not None:
        rows = np.concatenate([rows, looked_for.normal[0]])
        gradients = {n: np.concatenate([g, looked_for.normal[1][n]]) for n, g in gradients.items()}
    found = [deterministic(n, axes[n], looked_for.values[n], g) for n, g in gradients.items()]
    found += observed(problem, rows, looked_for.unnamed)

    def test(family: Family, scores: np.ndarray) -> FamilyTest:
        own, normal = np.split(scores, [len(drawn.rows)])
        return family_test(family, own, normal if len(normal) else None)

    tested = [
        (site, [test(*family) for family in families(looked_for.along, looked_for.over, site)])
        for site in found
    ]
    beyond: dict[str, list[FamilyTest]] = {}
    centre = projection.centre
    noise = drawn.rows if centre is None else centre.without_own(drawn.rows)  # no tail of own unknowns' prior
    for name, family, scores in further_moments(problem, fitted.x, noise):
        beyond.setdefault(name, []).append(family_test(family, scores))
    energy = _energy(problem, drawn)
    in_all = InAll.of([t for tests in (*(own for _, own in tested), *beyond.values()) for t in tests])
    findings = [
        _finding(problem, fitted, projection, drawn, energy=energy, site=site, tests=tests, in_all=in_all)
        for site, tests in tested
    ]
    further = [_beyond(name, tests, in_all) for name, tests in beyond.items()]
    return _Tested(tested, findings, [*further, *looked_for.repeated])


def _entries(site: Site, tests: Sequence[FamilyTest]) -> Iterator[np.ndarray]:
    """The map over the entries of a site of several axes."""
    wide = tuple(i for i, n in enumerate(site.value.shape) if n > 1)
    for test in tests if len(wide) > 1 else ():
        if (
            test.family.kind == "relative"
            and test.family.pattern.kept == wide
            and test.family.pattern.curves is None
        ):
            gain = np.where(test.seen, 0.5 * (test.told - 1), 0.0)
            yield gain.reshape(*site.value.shape, -1).sum(-1)


def _energy(problem: Problem, drawn: Replicates) -> float:
    """Of the data's residuals, over its mean over replicates."""
    energy = (drawn.rows[:, problem.rows.is_location] ** 2).sum(1)
    return float(energy[0] / max(energy[1:].mean(), 1e-300))


def _beyond(name: str, tests: Sequence[FamilyTest], in_all: InAll) -> SiteFinding:
    """The further moment of an observation with the smallest p-value; nothing that a fit could move stands for it."""
    best = min(tests, key=lambda test: test.p_value)
    return SiteFinding(name, best.family.kind, best.pattern, in_all.p_value(best), None)


def _each(test: FamilyTest) -> float:
    """The data's squared score over its variance, on average over the entries; tells families apart where p-values end."""
    seen = test.seen
    return float(test.told[seen].mean()) if seen.any() else 0.0


def _finding(
    problem: Problem,
    fitted: Fit,
    projection: Projection,
    drawn: Replicates,
    *,
    energy: float,
    site: Site,
    tests: Sequence[FamilyTest],
    in_all: InAll,
) -> SiteFinding:
    """The smallest p-value of a site's families, with the gain along that family's steepest direction."""
    best = min(tests, key=lambda test: (in_all.p_value(test), test.p_value, -_each(test)))
    steps = np.stack([best.family.step(score, best.variance, site.value) for score in best.first])
    shifts = projection.rows(shifted(problem, fitted.x, site, steps))
    gain = gains(drawn.rows[: 1 + CHANCE], shifts, problem.rows.is_spread)
    net, beyond = (max(float(gain[0] - e * gain[1:].mean()), 0.0) for e in (1.0, energy))
    if _FOLLOWS * len(best.variance) > problem.observed.count:  # so many weights follow noise wherever it is
        beyond = 0.0
    p_value = in_all.p_value(best)
    moved = np.sum(shifts[0] ** 2)
    spreads = bool(moved > 0 and np.sum(shifts[0][problem.rows.is_spread] ** 2) > _ALL_SPREAD * moved)
    score = max(map(_each, tests))
    named, place = best, None
    if p_value <= SURE:
        named = plainest(best, tests)
        place = foremost(named, tests, site, names_of_entries(problem.data))
    curves, parts = best.family.pattern.curves, 2 if np.iscomplexobj(site.value) else 1
    fewest = (int(entries.sum()) for entries in problem.observed.counted.values())
    return SiteFinding(
        site.name,
        named.family.kind,
        named.pattern,
        p_value,
        net,
        spreads=spreads,
        beyond_noise=beyond,
        score=score,
        place=place,
        whereabouts=named.whereabouts,
        is_ripple=curves is not None and curves.ripple is not None,
        is_of_each=curves is None and len(best.variance) // parts >= min(fewest),
    )
