"""Refits with one more effect."""

import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.effects import catalogue
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.fitting.refit import refit, starting_points
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.models.declaration import declare
from dtprob.models.label_twin import label_twin
from tests.unit.gap.examples import bend, draw, line


def test_a_field_whose_unit_is_small_is_found():
    """Offsets of 2.5 dB in 36 cells of about 11 labels, errors of 4 dB: a field of 0.1 dB is too faint to start from."""
    rng = np.random.default_rng(2)
    x = rng.uniform(size=(400, 2))
    cell = (np.floor(6 * x) @ [6, 1]).astype(int)
    prediction = -80 + 10 * rng.standard_normal(400)
    y = prediction + 2.5 * rng.standard_normal(36)[cell] + 4 * rng.standard_normal(400)
    data = {"x": jnp.asarray(x), "prediction": jnp.asarray(prediction), "y": jnp.asarray(y)}
    effects = catalogue(declare(label_twin, data).sites, data, use="stale_map")
    problem = Problem(label_twin, data, effects).with_live(["stale_map"])
    base = fitting.fit(problem, problem.null() + np.log(4.0))
    found = refit(problem, base, effects[0], [])
    assert 1.5 < found.spread["stale_map"] < 5.0
    assert found.log_evidence > base.log_evidence + 10


def test_edges_are_looked_for_beside_the_best_size():
    """A bias in the upper 44% of a feature; beside no bias the edge of the upper third says nothing."""
    rng = np.random.default_rng(4)
    x = rng.uniform(size=(300, 1))
    prediction = rng.standard_normal(300)
    y = prediction + 1.0 * (x[:, 0] > 0.56) + 0.3 * rng.standard_normal(300)
    data = {"x": jnp.asarray(x), "prediction": jnp.asarray(prediction), "y": jnp.asarray(y)}
    effects = catalogue(declare(label_twin, data).sites, data, use="regional_bias[x0_high]")
    problem = Problem(label_twin, data, effects).with_live(["regional_bias[x0_high]"])
    base = fitting.fit(problem, problem.null())
    starts = starting_points(problem, base.x, effects[0], None, Settings())
    edge = problem.layout["regional_bias[x0_high].from_quantile"].index[0]
    assert min(abs(start[edge].item() - 0.56) for start in starts) < 0.06
    found = refit(problem, base, effects[0], starts)
    np.testing.assert_allclose(found.x[edge], np.mean(x[:, 0] <= 0.56), atol=0.01)


@pytest.mark.parametrize(("step", "count"), [(0.0, 1), (0.5, 2)])
def test_a_hill_is_climbed_from_one_start(step, count):
    """One parameter, one hill: beside a good one-step estimate its top is no other start, beside a bad one it is."""
    data = draw("line", shift=0.4)
    problem = Problem(line, data, [bend()]).with_live(["bend"])
    base = fitting.fit(problem, problem.null())
    starts = starting_points(problem, base.x, problem.live[0], np.array([step]), Settings())
    assert len(starts) == count
    np.testing.assert_allclose(starts[0][problem.layout["bend.c"].index], step, atol=1e-6)
