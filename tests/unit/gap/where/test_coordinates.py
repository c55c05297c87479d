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
        located=np.ones(observed.shape), coordinates={"device": position}, by_cluster=lambda values: values
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
        located=np.ones((200, 1)), coordinates={"row": position}, by_cluster=lambda values: values
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
