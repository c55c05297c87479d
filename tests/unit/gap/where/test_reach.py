"""Where accepted causes close the gap: the blocks that they reach, and none where they do nothing."""

import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.where.reach import _held, reach
from tests.unit.gap.examples import N_LINK, N_SAMPLE, SIGMA, draw, jitter, line


def checked(name, links, samples):
    """The mean of some links and samples is higher and lower in turn, which no level or slope takes up."""
    where = np.zeros((N_LINK, N_SAMPLE))
    where[np.ix_(links, samples)] = (-1.0) ** np.add.outer(np.arange(len(links)), np.arange(len(samples)))
    return Effect(
        name, {"mean": lambda value, p, _: value + p["by"] * where}, (Parameter("by", dist.Normal(0.0, 1.0)),)
    ), where


HERE, AT = checked("here", range(4), range(N_SAMPLE))
LATE, LAST = checked("late", range(N_LINK), [5, 6, 7])


@pytest.fixture(scope="module")
def found():
    """(effects, where the mean is shifted) -> the blocks."""

    def blocks(effects, shift, seed=1):
        data = draw("line", seed=seed, shift=shift)
        problem = Problem(line, data, effects)
        base = fitting.fit(problem, np.zeros(problem.dimension))
        wider = problem.with_live([e.name for e in effects])
        fitted = fitting.fit(wider, wider.translate(base.x, problem), [e.name for e in effects])
        return reach(problem, base, project(problem, base), wider, fitted)

    return blocks


def test_links_that_a_cause_reaches(found):
    blocks = found([HERE], 1.2 * AT)
    assert {(b.axis, b.low, b.high) for b in blocks} == {("link", k, k) for k in range(4)}
    assert all(b.p_value < 0.01 and b.excess > 0 for b in blocks)
    strongest = max(blocks, key=lambda b: b.excess)  # one of four that were looked at
    assert strongest.p_value == pytest.approx(4 * stats.norm.sf(np.sqrt(2 * strongest.excess)), rel=1e-6)


def test_neighbours_along_another_axis_are_one_block(found):
    assert [(b.axis, b.low, b.high) for b in found([LATE], 1.2 * LAST)] == [("sample", 5, 7)]


def test_a_cause_that_is_everywhere_is_at_no_place(found):
    everywhere, where = checked("everywhere", range(N_LINK), range(N_SAMPLE))
    assert found([everywhere], 0.8 * where) == ()


def test_an_axis_along_which_nothing_moves_has_no_places():
    assert list(_held(np.zeros(3), together=True)) == []
    assert list(_held(np.array([0.0, 4.0, 5.0, 0.0, 0.1, 0.0]), together=True)) == [(1, 2)]


def test_a_random_field_tells_no_place(found):
    assert found([jitter()], 0.5 * AT) == ()


def test_links_where_the_cause_does_nothing_are_hardly_ever_called(found):
    """Four links are said to be raised, three are; bound for 40 data sets at 1%, missed once in a thousand times."""
    shift = AT.copy()
    shift[3] = 0.0
    called = [{b.low for b in found([HERE], 1.2 * shift, seed=1 + s) if b.axis == "link"} for s in range(40)]
    assert sum(3 in links for links in called) <= stats.binom.isf(1e-3, 40, 0.01)
    left = 0.9 * 1.2  # after level and slope were fitted
    power = stats.norm.sf(stats.norm.isf(0.01 / 4) - left * np.sqrt(N_SAMPLE) / SIGMA)
    hits = sum(len({0, 1, 2} & links) for links in called)
    assert hits >= stats.binom.ppf(1e-3, 120, power)
