"""How large a gap is in the user's own terms, against sums by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.errors import InputError
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.how_far import closed
from dtprob.gap.how_far.terms import check_tolerance, in_user_terms, is_within
from dtprob.gap.model.problem import Problem
from dtprob.models.declaration import Measure, declare, model
from dtprob.models.multi_access import multi_access, records
from dtprob.models.multi_access.model import MEASURES
from tests.small_network import CLUSTERS, simulate

RUNS, ROWS = 6, 5


def doubled(sites, data):
    return 2 * sites["level"] * jnp.ones((RUNS, ROWS)), 2 * data["y"]


@model(cluster="run", measures={"twice_error": Measure("y", doubled)})
def levels(y=None, kind="normal"):
    level = numpyro.deterministic("level", numpyro.sample("m", dist.Normal(1.0, 3.0)))
    law = {
        "normal": lambda: dist.Normal(level, 0.5),
        "power": lambda: dist.LogNormal(level, 0.5),
        "counts": lambda: dist.Poisson(jnp.exp(level)),
        "angles": lambda: dist.VonMises(level, 4.0),
        "outcomes": lambda: dist.Bernoulli(logits=level),
    }[kind]()
    with numpyro.plate("run", RUNS, dim=-2), numpyro.plate("row", ROWS, dim=-1):
        numpyro.sample("y", law, obs=y)


def held_out(kind, y):
    problem = Problem(levels, {"y": jnp.asarray(y), "kind": kind}, [])
    fitted = fitting.fit(problem, np.zeros(1), tolerance=1e-10)
    everything = [closed.Fold(np.ones(RUNS, bool), fitted, np.zeros(RUNS))]
    return problem, closed.judged(problem, everything), float(fitted.x[0])


RNG = np.random.default_rng(0)
DATA = {
    "normal": RNG.normal(2.0, 0.5, (RUNS, ROWS)),
    "power": np.exp(RNG.normal(1.0, 0.5, (RUNS, ROWS))),
    "counts": RNG.poisson(3.0, (RUNS, ROWS)),
    "angles": np.angle(np.exp(1j * RNG.normal(3.0, 0.5, (RUNS, ROWS)))),
}
WRONG_BY = {
    "normal": lambda y, level: y - level,
    "power": lambda y, level: 10 / np.log(10) * (np.log(y) - level),
    "counts": lambda y, level: y - np.exp(level),
    "angles": lambda y, level: np.angle(np.exp(1j * (y - level))),
}


@pytest.mark.parametrize("kind", sorted(DATA))
def test_errors_are_in_the_unit_of_the_data(kind):
    y = DATA[kind]
    problem, held, level = held_out(kind, y)
    found = in_user_terms(problem, held, None)
    name = "y_rmse_db" if kind == "power" else "y_rmse"
    expected = np.sqrt(np.mean(WRONG_BY[kind](y, level) ** 2))
    assert found[name] == (pytest.approx(expected, rel=1e-6), None)
    by_run = 2 * (level - y).mean(1)
    assert found["twice_error"][0] == pytest.approx(np.sqrt(np.mean(by_run**2)), rel=1e-6)


@pytest.mark.parametrize("kind", sorted(DATA))
def test_a_tolerance_is_compared_with_the_error_in_the_unit_of_the_data(kind):
    """Levels in dBm are numbers far from zero: an error relative to these would make any fault of a few dB a small one."""
    problem, held, _ = held_out(kind, DATA[kind])
    error = next(
        value for name, (value, _) in in_user_terms(problem, held, None).items() if name != "twice_error"
    )
    assert is_within(problem, held, 1.001 * error)
    assert not is_within(problem, held, 0.999 * error)


def test_a_tolerance_says_nothing_of_classes():
    problem, held, _ = held_out("outcomes", RNG.integers(0, 2, (RUNS, ROWS)))
    check_tolerance(problem, held.misses, None)
    with pytest.raises(InputError, match=r"tolerance_db.*Bernoulli.*Leave the tolerance out"):
        check_tolerance(problem, held.misses, 1.0)


def test_outcomes_have_no_error_but_measures():
    problem, held, _ = held_out("outcomes", (RNG.random((RUNS, ROWS)) < 0.7).astype(int))
    assert set(in_user_terms(problem, held, held)) == {"twice_error"}


def test_a_measure_of_no_observed_site_is_refused():
    astray = model(measures={"lost_error": Measure("level", doubled)})(lambda y=None: levels(y))
    with pytest.raises(InputError, match=r"measure lost_error.*'level'"):
        declare(astray, {"y": jnp.asarray(DATA["normal"])})


def test_a_network_tells_packets_per_slot():
    data = {**records(simulate(120, 0), clusters=CLUSTERS, window=20), "concentration": 1.0}
    problem = Problem(multi_access, data, [])
    x = problem.prior_draws(jax.random.key(1), 1)[0]
    sites = {n: np.asarray(v) for n, v in problem.compiled.sites(x).items()}
    found = problem.compiled.misses(x)
    assert set(found) == set(MEASURES)
    law = np.asarray(jax.nn.softmax(sites["reception_logits"]))
    delivered = (law * np.arange(law.shape[-1])).sum(-1).mean(1) - np.asarray(data["deliveries"]).mean(1)
    np.testing.assert_allclose(found["throughput_error"].error, delivered**2, rtol=1e-6, atol=1e-12)
    arrivals = np.asarray(jax.nn.softmax(sites["arrival_logits"]))
    packets = np.array([[0, 1, 1, 2]] * 2)
    seen = packets[0][np.asarray(data["arrivals"])].sum(-1).mean(1)
    load = np.broadcast_to((arrivals * packets).sum((-2, -1)), data["deliveries"].shape).mean(1) - seen
    np.testing.assert_allclose(found["load_error"].error, load**2, rtol=1e-6, atol=1e-12)
