"""Data that users have: missing values, a sensor that is absent, phases in rows, scenes of a bench."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.effects import catalogue
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.fitting.base import fit_base
from dtprob.gap.fitting.bootstrap import normal_like, replicate
from dtprob.gap.fitting.projection import project
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.inference import Laplace
from dtprob.models.dirichlet import LogDirichlet
from tests import small_world

ROWS = 80
FAST = Settings(replicates=100, site_replicates=50)


def told(model, **data):
    return diagnose(model, data, [], key=jax.random.key(0), engine=Laplace(), settings=FAST)


def two_sensors(height, other_seen, seen, one=None, other=None):
    del height
    level = numpyro.sample("level", dist.Normal(0.0, 5.0))
    mean = numpyro.deterministic("mean", level + jnp.zeros(ROWS))
    with numpyro.plate("row", ROWS):
        numpyro.sample("one", dist.Normal(mean, 1.0).mask(seen), obs=one)
        numpyro.sample("other", dist.Normal(mean, 1.0).mask(other_seen), obs=other)


def sensors(**changed):
    rng = np.random.default_rng(0)
    given = {
        "height": rng.normal(size=ROWS),
        "other_seen": np.ones(ROWS, bool),
        "seen": np.ones(ROWS, bool),
        "one": rng.normal(size=ROWS),
        "other": rng.normal(size=ROWS),
    }
    return {name: jnp.asarray(value) for name, value in (given | changed).items()}


def test_a_column_with_a_missing_value_is_refused_by_name_though_the_model_does_not_use_it():
    height = np.random.default_rng(1).normal(size=ROWS)
    height[7] = np.nan
    with pytest.raises(InputError, match=r"data height: expected finite numbers .* the first at \[7\]"):
        told(two_sensors, **sensors(height=height))
    seen = np.arange(ROWS) != 7
    assert told(two_sensors, **sensors(height=height, seen=seen, other_seen=seen)).verdict == "NO_GAP"


def test_a_column_may_have_gaps_beside_the_readings_of_one_sensor():
    """It is the other's, which sent nothing there."""
    sent = np.arange(ROWS) % 4 > 0
    height = np.where(sent, np.random.default_rng(1).normal(size=ROWS), np.nan)
    assert told(two_sensors, **sensors(height=height, other_seen=sent)).verdict == "NO_GAP"
    with pytest.raises(InputError, match="data height"):
        told(two_sensors, **sensors(height=np.full(ROWS, np.nan)))


def test_a_sensor_that_is_absent_hinders_nothing():
    assert told(two_sensors, **sensors(other_seen=np.zeros(ROWS, bool))).verdict == "NO_GAP"


def test_clusters_in_which_nothing_was_observed_are_none():
    seen = np.arange(ROWS) < 3
    with pytest.raises(InputError, match="at least 4 independent ones, got 3"):
        told(two_sensors, **sensors(seen=seen, other_seen=seen))


def test_phases_in_rows_of_no_plate_are_diagnosed():
    def phases(y=None):
        level = numpyro.sample("level", dist.VonMises(0.0, 0.1))
        mean = numpyro.deterministic("mean", level + jnp.zeros(120))
        numpyro.sample("y", dist.VonMises(mean, 20.0).to_event(0), obs=y)

    rng = np.random.default_rng(0)
    drift = 0.15 * np.arange(120) + 0.2 * rng.normal(size=120)
    found = told(phases, y=jnp.asarray((drift + np.pi) % (2 * np.pi) - np.pi))
    assert found.verdict == "UNLISTED"


def test_what_does_not_count_has_no_share_in_normal_rows():
    def counts(seen, y=None):
        rate = numpyro.sample("rate", dist.LogNormal(1.0, 1.0))
        with numpyro.plate("row", ROWS):
            numpyro.sample("y", dist.Poisson(rate).mask(seen), obs=y)

    seen = np.arange(ROWS) % 5 == 0
    data = {"seen": jnp.asarray(seen), "y": jnp.asarray(np.random.default_rng(0).poisson(3.0, ROWS))}
    problem = Problem(counts, data, [])
    fitted = fit_base(problem, jax.random.key(0))
    drawn = replicate(problem, fitted, project(problem, fitted), jax.random.key(1), FAST)
    rows, _ = normal_like(drawn)
    (own,) = problem.rows.by_site(rows).values()
    np.testing.assert_array_equal(own[:, 0, ~seen], 0.0)
    (replicates,) = problem.rows.by_site(drawn.rows[1:]).values()
    pooled = [np.var(r[:, 0].sum(1)) for r in (own, replicates)]
    assert pooled[0] == pytest.approx(pooled[1], rel=0.7, abs=2.0)


@pytest.mark.parametrize("scale", [0.02, 0.06, 1.0])
def test_screens_of_a_small_scene_have_names_of_their_own(scale):
    world = small_world.build()
    paths = world.data["paths"]
    places = ("tx_position", "rx_position", "vertex")
    shrunk = eqx.tree_at(
        lambda p: [getattr(p, n) for n in places],
        paths,
        [scale * np.asarray(getattr(paths, n)) for n in places],
    )
    offered = catalogue(world.sites, {**world.data, "paths": shrunk}, "missing_object")
    assert len({effect.name for effect in offered}) == len(offered) > 5


CHANCES = np.array(
    [[0.9, 0.1, 0.0, 0.0], [0.6, 0.33, 0.07, 0.0], [0.86, 0.07, 0.07, 0.0], [0.97, 0.0, 0.03, 0.0]]
)


def by_log_ratios():
    return numpyro.sample("table", LogDirichlet(0.5, np.ones((4, 4), bool)))


def by_sticks():
    return jnp.log(numpyro.sample("table", dist.Dirichlet(0.5 * jnp.ones((4, 4))).to_event(1)))


@pytest.mark.parametrize("table", [by_log_ratios, by_sticks])
@pytest.mark.parametrize("seed", [0, 3])
def test_outcomes_that_never_come_are_no_gap_of_a_table_of_chances(table, seed):
    """Where nothing of an outcome was seen its log ratio lies in an exponential tail, of hardly a curvature."""

    def outcomes(group, y=None):
        logits = numpyro.deterministic("logits", table()[group])
        with numpyro.plate("slot", len(group)):
            numpyro.sample("y", dist.Categorical(logits=logits), obs=y)

    rng = np.random.default_rng(seed)
    group = rng.choice(4, size=800, p=[0.3, 0.4, 0.2, 0.1])
    y = np.array([rng.choice(4, p=CHANCES[i]) for i in group])
    assert told(outcomes, group=group, y=y).verdict == "NO_GAP"
    late = np.arange(len(y)) > 400
    y = np.where(late & (rng.random(len(y)) < 0.3), 1, y)
    assert told(outcomes, group=group, y=y).verdict == "UNLISTED"
