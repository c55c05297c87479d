"""Misfit over coordinates: in standard deviations where something is observed, and nothing said where it is not."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from dtprob.gap.where.coordinates import scan_coordinates
from dtprob.report.axis_figures import usual_limit


def scanned(observed, null, *, outcomes=False):
    """The scan of residuals (cluster, row), one row for each of three devices."""
    position = np.broadcast_to(np.arange(3), observed.shape)
    rows = SimpleNamespace(
        is_location=np.ones(observed.shape, bool),
        coordinates={"device": position},
        by_cluster=lambda values: values,
    )
    families = {"heard": "BernoulliLogits" if outcomes else "Normal"}
    problem = SimpleNamespace(rows=rows, declaration=SimpleNamespace(cluster="link"), families=families)
    return scan_coordinates(problem, SimpleNamespace(rows=np.stack([observed, *null])))


def test_a_position_without_observations_has_no_excess():
    rng = np.random.default_rng(0)
    observed, null = rng.standard_normal((50, 3)), rng.standard_normal((200, 50, 3))
    observed[:, 2], null[..., 2] = 0.0, 0.0
    excess = scanned(observed, null)[1]["device"]
    assert np.isnan(excess[2])
    energy = (observed[:, 0] ** 2).sum()
    assert excess[0] == pytest.approx(stats.norm.isf(stats.chi2(50).sf(energy)), abs=0.4)


def test_single_readings_of_a_right_twin_stay_where_normal_scores_do():
    """A square of one reading is 8 standard deviations off once in two hundred."""
    rng = np.random.default_rng(3)
    rows = rng.standard_normal((400, 200, 1))
    position = np.arange(200)[:, None]
    one = SimpleNamespace(
        is_location=np.ones((200, 1), bool), coordinates={"row": position}, by_cluster=lambda values: values
    )
    problem = SimpleNamespace(
        rows=one, declaration=SimpleNamespace(cluster="row"), families={"heard": "Normal"}
    )
    largest = []
    for k in range(40):
        drawn = SimpleNamespace(rows=np.concatenate([rows[k : k + 1], rows[40:]]))
        largest.append(np.abs(scan_coordinates(problem, drawn)[1]["row"]).max())
    assert np.mean(np.array(largest) > usual_limit(200)) <= 0.2  # 2 of 40 are to be expected, 9 with p 1e-3


def test_a_position_that_strays_is_found():
    rng = np.random.default_rng(1)
    observed, null = rng.standard_normal((50, 3)), rng.standard_normal((200, 50, 3))
    observed[:, 1] *= 2
    blocks, _ = scanned(observed, null)
    assert (blocks[0].axis, blocks[0].low, blocks[0].high) == ("device", 1, 1)
    assert blocks[0].p_value < 1e-3


def test_one_rare_outcome_is_no_misfit_that_replicates_have_not_seen():
    """Of 150 outcomes that are seen with a chance of .001 each one is seen: no device stands out for it."""
    rng, chance = np.random.default_rng(2), 1e-3
    observed = np.full((50, 3), -np.sqrt(chance / (1 - chance)))
    null = np.repeat(observed[None], 200, axis=0) + 1e-3 * rng.standard_normal((200, 50, 3))
    observed[17, 1] = np.sqrt((1 - chance) / chance)
    assert scanned(observed, null, outcomes=True)[0] == ()
    observed[:25, 1] = observed[17, 1]  # half of them are another matter
    assert scanned(observed, null, outcomes=True)[0][0].p_value < 1e-3


def rows_in_order(rows, *, outcomes=False):
    """The scan of residuals (draw, row) of a table of which each row is a cluster, in order."""
    one = SimpleNamespace(
        is_location=np.ones((1, rows.shape[1]), bool),
        coordinates={"row": np.arange(rows.shape[1])[None]},
        by_cluster=lambda values: values,
    )
    families = {"heard": "BernoulliLogits" if outcomes else "Normal"}
    problem = SimpleNamespace(rows=one, declaration=SimpleNamespace(cluster="device"), families=families)
    return scan_coordinates(problem, SimpleNamespace(rows=rows[:, None, :]))[0]


def skew_counts(rng, shape):
    """Whitened negative binomial counts of mean 4."""
    return (rng.poisson(4.0 * rng.gamma(2.9, 1 / 2.9, size=shape)) - 4.0) / np.sqrt(4.0 + 16.0 / 2.9)


READINGS = {
    "normal": lambda rng, shape: rng.standard_normal(shape),
    "skew counts": skew_counts,
    "exponential": lambda rng, shape: rng.exponential(size=shape) - 1,
    "outcomes": lambda rng, shape: ((rng.random(shape) < 0.01) - 0.01) / np.sqrt(0.0099),
}


@pytest.mark.study
@pytest.mark.parametrize("kind", READINGS)
def test_no_block_of_a_right_twin_stands_out_more_often_than_it_is_said(kind):
    """100 data sets of 200 rows, against 99 replicates each, at 1%; bound missed once in a thousand times."""
    rng = np.random.default_rng(4)
    called = sum(
        bool(rows_in_order(READINGS[kind](rng, (100, 200)), outcomes=kind == "outcomes")) for _ in range(100)
    )
    assert called <= stats.binom.isf(1e-3, 100, 0.01)


@pytest.mark.parametrize("kind", ["normal", "skew counts", "exponential"])
def test_a_block_of_neighbours_that_stray_is_found(kind):
    """Single skew readings stray farther than blocks, which do not have to be told from these."""
    rng, hits = np.random.default_rng(5), 0
    for _ in range(10):
        rows = READINGS[kind](rng, (100, 600))
        rows[0, 192:256] *= 3.0
        found = rows_in_order(rows)
        hits += bool(found) and found[0].low >= 160 and found[0].high < 288
    assert hits >= stats.binom.ppf(1e-3, 10, 0.9)


@pytest.mark.parametrize("place", [6, 7, 12])
def test_one_strong_position_is_told_without_its_neighbour(place):
    """Where p-values end, blocks of all lengths are as sure."""
    rows = np.random.default_rng(0).normal(size=(100, 40))
    rows[0, place] = 90.0
    (found,) = rows_in_order(rows)
    assert (found.low, found.high) == (place, place)
