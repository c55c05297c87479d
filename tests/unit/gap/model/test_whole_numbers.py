"""Sites of whole numbers take part as real ones: the oracle is the same model with real numbers in the data."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.contrib.control_flow import scan

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.diagnose import diagnose
from dtprob.gap.model.problem import Problem
from dtprob.gap.model.whole_numbers import real_sites
from dtprob.inference.laplace import Laplace
from dtprob.testing import check_effect

N = 60
RNG = np.random.default_rng(0)
X = RNG.integers(1, 20, N)
LIFT = Effect(
    "lift", {"mean": lambda v, p, c: v + p["by"]}, (Parameter("by", dist.Normal()),), physics="A bias."
)


def line(x, y=None):
    noise = numpyro.sample("noise", dist.HalfNormal(1.0))
    with numpyro.plate("row", len(x)):
        mean = numpyro.deterministic("mean", x)
        numpyro.sample("y", dist.Normal(mean, noise), obs=y)


def kinds(model, **data):
    data = {name: jnp.asarray(value) for name, value in data.items()}
    problem = Problem(model, data, [])
    sites = problem.compiled.sites(problem.prior_spread.middle)
    return {n: sites[n].dtype.kind for n in problem.declaration.deterministic}


@pytest.mark.study
def test_whole_numbers_are_diagnosed_as_real_ones():
    y = X + 0.5 + 0.4 * RNG.normal(size=N)
    found = [
        diagnose(
            line,
            {"x": jnp.asarray(x), "y": jnp.asarray(y)},
            [LIFT],
            key=jax.random.key(1),
            engine=Laplace(draws=100),
        )
        for x in (X, X.astype(float))
    ]
    assert [one.verdict for one in found] == ["LISTED", "LISTED"]
    assert found[0].causes[0].size == found[1].causes[0].size
    assert found[0].causes[0].size[0].mean == pytest.approx(0.5, abs=0.2)


def test_an_effect_of_ones_own_on_whole_numbers_passes_its_check():
    check_effect(LIFT, line, {"x": jnp.asarray(X), "y": jnp.asarray(X, float)})


def test_what_points_into_an_array_stays_whole():
    def levels(site, count, y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 1.0).expand([4]).to_event(1))
        at = numpyro.deterministic("at", site)
        own = numpyro.deterministic("own", count)
        with numpyro.plate("row", len(site)):
            numpyro.sample("y", dist.Normal(level[at] + own, 1.0), obs=y)

    assert kinds(levels, site=X % 4, count=X, y=RNG.normal(size=N)) == {"at": "i", "own": "f"}


def test_what_has_no_slope_stays_whole():
    """Neither what flips a sign, nor what is observed, nor bits, nor large numbers in single precision."""

    def odd(x, y=None, z=None):
        sign = numpyro.deterministic("sign", x)
        bits = numpyro.deterministic("bits", x + 0)
        seen = numpyro.deterministic("seen", z)
        with numpyro.plate("row", len(x)):
            numpyro.sample("y", dist.Normal((-1.0) ** sign + (bits & 1), 1.0), obs=y)
            numpyro.sample("z", dist.Poisson(3.0), obs=seen)

    assert kinds(odd, x=X, y=RNG.normal(size=N), z=X) == {"sign": "i", "bits": "i", "seen": "i"}


def test_numbers_that_real_ones_cannot_hold_stay_whole():
    def late(time, y=None):
        at = numpyro.deterministic("at", time)
        with numpyro.plate("row", len(time)):
            numpyro.sample("y", dist.Normal(at - 2**62, 100.0), obs=y)

    assert kinds(late, time=2**62 + X, y=RNG.normal(size=N)) == {"at": "i"}


def test_sites_in_a_scan():
    def walk(x, y=None):
        start = numpyro.sample("start", dist.Normal(0.0, 1.0))

        def step(state, now):
            x, y = now
            load = numpyro.deterministic("load", x)
            numpyro.sample("y", dist.Normal(0.5 * state + load, 1.0), obs=y)
            return 0.5 * state, None

        scan(step, start, (x, y))

    y = RNG.normal(size=N)
    assert kinds(walk, x=X, y=y) == {"load": "f"}
    shifts = []
    for x in (X, X.astype(float)):
        problem = Problem(walk, {"x": jnp.asarray(x), "y": jnp.asarray(y)}, [])
        deltas = {"load": jnp.asarray(RNG.normal(size=(1, N)) * 0 + 1.0)}
        shifts.append(np.asarray(problem.compiled.site_shift(problem.null(), deltas)))
    np.testing.assert_array_equal(*shifts)


def test_counts_of_trials_have_the_density_that_they_had():
    def tries(trials, y=None):
        chance = numpyro.sample("chance", dist.Beta(2.0, 2.0))
        with numpyro.plate("row", len(trials)):
            count = numpyro.deterministic("count", trials)
            numpyro.sample("y", dist.Binomial(count, chance), obs=y)

    y = RNG.binomial(X, 0.3)
    data = {"trials": jnp.asarray(X), "y": jnp.asarray(y)}
    problem = Problem(tries, data, [])
    likelihood = problem.compiled.evaluate(np.zeros(1))[0]
    np.testing.assert_allclose(likelihood, dist.Binomial(jnp.asarray(X), 0.5).log_prob(y), rtol=1e-12)


def test_a_model_without_whole_numbers_is_itself():
    data = {"x": jnp.asarray(X, float), "y": jnp.asarray(X, float)}
    assert real_sites(line, data) is line
