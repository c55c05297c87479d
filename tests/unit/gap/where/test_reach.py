"""Where accepted causes close the gap: the blocks that they reach, and none where they do nothing."""

import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.where.closed_share import closed_shares
from dtprob.gap.where.reach import Told, _held, reached, told
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
    return lambda effects, shift, seed=1: reached(along(effects, shift, seed), "link", len(effects))


def along(effects, shift, seed=1):
    """What each position of every axis tells of the effects, where the mean is shifted."""
    data = draw("line", seed=seed, shift=shift)
    problem = Problem(line, data, effects)
    base = fitting.fit(problem, np.zeros(problem.dimension))
    wider = problem.with_live([e.name for e in effects])
    fitted = fitting.fit(wider, wider.translate(base.x, problem), [e.name for e in effects])
    return told(problem, base, project(problem, base), wider, fitted)


def test_links_that_a_cause_reaches(found):
    blocks = found([HERE], 1.2 * AT)
    assert {(b.axis, b.low, b.high) for b in blocks} == {("link", k, k) for k in range(4)}
    assert all(b.p_value < 0.01 and b.excess > 0 for b in blocks)
    strongest = max(blocks, key=lambda b: b.excess)  # one of four that were looked at
    here = along([HERE], 1.2 * AT)["link"]
    z = here.product[strongest.low] / np.sqrt(here.energy[strongest.low])
    assert strongest.excess == pytest.approx(here.gain[strongest.low])
    assert strongest.p_value == pytest.approx(4 * stats.chi2.sf(z**2, 1), rel=1e-6)


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


@pytest.mark.study
def test_links_where_the_cause_does_nothing_are_hardly_ever_called(found):
    """Four links are said to be raised, three are; bound for 40 data sets at 1%, missed once in a thousand times."""
    shift = AT.copy()
    shift[3] = 0.0
    called = [{b.low for b in found([HERE], 1.2 * shift, seed=1 + s) if b.axis == "link"} for s in range(40)]
    assert sum(3 in links for links in called) <= stats.binom.isf(1e-3, 40, 0.01)
    left = 0.9 * 1.2  # after level and slope were fitted
    power = stats.norm.sf(stats.norm.isf(0.0025 / 4) - left * np.sqrt(N_SAMPLE) / SIGMA)
    hits = sum(len({0, 1, 2} & links) for links in called)
    assert hits >= stats.binom.ppf(1e-3, 120, power)


def scattered(rng, kept=1.0):
    """Of 200 positions every fourth tells of a cause at lambda 2, a share of them really; what they tell, and which."""
    energy = np.where(np.arange(200) % 4 == 0, 2.0, 0.0)
    real = rng.uniform(size=200) < kept
    product = energy * real + np.sqrt(energy) * rng.normal(size=200)
    return {"row": Told(product, energy, energy > 0)}, np.flatnonzero(energy)


def test_places_too_weak_alone_are_told_together():
    """Fifty rows of a table in no order, lambda 2 each: hardly one of them shows by itself."""
    along_row, cells = scattered(np.random.default_rng(0))
    here, blocks = along_row["row"], reached(along_row, "row", 1)
    assert sum(len(b.parts) or 1 for b in blocks) == 0.9 * len(cells)
    rest = [low for low, _ in blocks[0].parts]
    assert len(rest) > 30
    assert set(rest) <= set(cells.tolist())
    assert blocks[0].excess == pytest.approx(here.gain[rest].sum())
    z = here.product[rest].sum() / np.sqrt(here.energy[rest].sum())
    assert blocks[0].p_value == pytest.approx(stats.chi2.sf(z**2, 1))
    assert blocks[0].p_value < 1e-6


def test_places_where_nothing_is_closed_are_hardly_ever_told_together():
    """300 data sets in which the cause does nothing at 1%; bound missed once in a thousand times."""
    rng = np.random.default_rng(1)
    called = sum(bool(reached(scattered(rng, kept=0.0)[0], "row", 1)) for _ in range(300))
    assert called <= stats.binom.isf(1e-3, 300, 0.01)


@pytest.mark.parametrize("count", [1, 4])
def test_single_places_and_their_sum_share_one_level(count):
    """Of 4,000 data sets in which the cause does nothing, but for a sign that is fitted to them, 1% are called."""
    rng, energy, called = np.random.default_rng(4), np.where(np.arange(20) % 2 == 0, 1.0, 0.0), 0
    energy[2 * count :] = 0.0
    for _ in range(4000):
        product = np.sqrt(energy) * rng.normal(size=20)
        here = Told(np.copysign(1.0, product.sum()) * product, energy, energy > 0)
        called += bool(reached({"row": here}, "row", 1))
    assert stats.binom.isf(0.999, 4000, 0.007) <= called <= stats.binom.isf(1e-3, 4000, 0.01)


def test_what_is_fitted_to_each_position_is_no_place():
    """A weight for each of 20 positions fitted to 200 data sets, of which one closes something; at 1%."""
    rng, called = np.random.default_rng(3), 0
    for _ in range(200):
        readings = rng.normal(size=60)
        readings[3] += 9.0
        fitted = np.where(np.arange(60) < 20, 0.9 * readings, 0.0)
        here = {"row": Told(fitted * readings, fitted**2, fitted != 0)}
        called += any(b.parts or b.low != 3 for b in reached(here, "row", 20))
    assert called <= stats.binom.isf(1e-3, 200, 0.01)


def test_positions_that_refitted_nuisances_alone_move_are_not_reached():
    """One sample is raised, and level and slope refit there; of three, all tell of the cause by that."""
    raised = np.zeros((N_LINK, N_SAMPLE))
    raised[:, 5] = 1.0
    up = Effect(
        "up",
        {"mean": lambda value, p, _: value + p["by"] * raised},
        (Parameter("by", dist.Normal(0.0, 1.0)),),
    )
    here = along([up], 1.2 * raised)["sample"]
    assert (here.energy > 0).all()
    np.testing.assert_array_equal(np.flatnonzero(here.touched), [5])
    assert [(b.low, b.high) for b in reached({"sample": here}, "link", 1)] == [(5, 5)]


def test_shares_of_what_is_closed_and_their_spread():
    """Over 4,000 data sets a position's share of the nats has the mean and the spread that the map draws."""
    rng = np.random.default_rng(2)
    energy = np.array([8.0, 1.0, 0.0, 16.0])
    gains = []
    for _ in range(4000):
        here = Told(energy + np.sqrt(energy) * rng.normal(size=4), energy, energy > 0)
        share = closed_shares({"axis": here}).get("axis")
        if share is None:
            gains.append(here.product - here.energy / 2)
            continue
        assert share.found.sum() == pytest.approx(1.0)
        assert share.expected * share.total == pytest.approx(energy / 2)
        gains.append(share.found * share.total)
    assert np.abs(np.mean(gains, axis=0) - energy / 2).max() < 4 * 4.0 / np.sqrt(4000)
    assert np.std(gains, axis=0) == pytest.approx(np.sqrt(energy), rel=0.05)


def test_no_shares_where_nothing_is_gained():
    assert closed_shares({"axis": Told(np.array([-1.0, 0.0]), np.array([1.0, 2.0]), np.ones(2, bool))}) == {}
    assert closed_shares({"one": Told(np.array([3.0]), np.array([1.0]), np.ones(1, bool))}) == {}


def test_a_cause_closes_the_gap_where_it_acts():
    share = closed_shares(along([HERE], 1.2 * AT))["link"]
    assert share.expected[:4].sum() > 0.9
    assert np.abs(share.found - share.expected).max() < 4 * np.sqrt(2 * share.expected.max() / share.total)
