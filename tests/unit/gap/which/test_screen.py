"""Which candidates are judged: what nuisances take up is not, unless the data show it all the same."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import optimize

from dtprob.effects.effect import Effect, Parameter
from dtprob.gap.fitting import fit as fitting
from dtprob.gap.model.problem import Problem
from dtprob.gap.settings import Settings
from dtprob.gap.view import view


def slope(x, apart, y=None):
    """A line through zero."""
    del apart
    b = numpyro.sample("b", dist.Normal(0.0, 100.0))
    with numpyro.plate("row", len(x)):
        mean = numpyro.deterministic("mean", b * x)
        numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)


def data_with(size):
    """Of the effect's column 99% is the slope's own."""
    rng = np.random.default_rng(0)
    x, apart, noise = rng.normal(size=(3, 400))
    return {
        "x": jnp.asarray(x),
        "apart": jnp.asarray(apart),
        "y": jnp.asarray(0.7 * x + size * (x + 0.1 * apart) + noise),
    }


def nearly_the_slope(prior):
    return Effect(
        "nearly",
        {"mean": lambda value, p, context: value + p["by"] * (context["x"] + 0.1 * context["apart"])},
        (Parameter("by", prior),),
    )


@pytest.mark.parametrize(("size", "hidden_by"), [(0.0, "b"), (3.5, None)])
def test_what_the_data_show_is_not_absorbed(size, hidden_by):
    problem = Problem(slope, data_with(size), [nearly_the_slope(dist.Normal(0.0, 2.0))])
    base = fitting.fit(problem, problem.null())
    seen = view(problem, base, jax.random.key(0), Settings(replicates=100, site_replicates=19), located=False)
    assert seen.screening.absorbed_by == (hidden_by,)


@pytest.mark.parametrize(
    ("size", "deviation", "far"), [(3.5, 2.0, False), (3.5, 0.5, True), (0.0, 0.01, False)]
)
def test_what_a_prior_all_but_excludes_is_told(size, deviation, far):
    problem = Problem(slope, data_with(size), [nearly_the_slope(dist.Normal(0.0, deviation))])
    base = fitting.fit(problem, problem.null())
    seen = view(problem, base, jax.random.key(0), Settings(replicates=100, site_replicates=19), located=False)
    (beyond,) = seen.screening.beyond
    assert (beyond is not None) == far
    assert beyond is None or beyond == pytest.approx(3.5 / deviation, rel=0.2)


@pytest.mark.parametrize(("size", "opposite"), [(3.5, False), (0.0, False), (-3.5, True)])
def test_what_the_data_ask_for_on_the_side_that_a_prior_excludes(size, opposite):
    problem = Problem(slope, data_with(size), [nearly_the_slope(dist.HalfNormal(2.0))])
    base = fitting.fit(problem, problem.null())
    seen = view(problem, base, jax.random.key(0), Settings(replicates=100, site_replicates=19), located=False)
    assert seen.screening.opposite == (opposite,)
    assert (seen.screening.z[0] < 0) == (size < 0) or size == 0


@pytest.mark.parametrize("prior", [dist.LogNormal(np.log(3.0), 0.2), dist.Gamma(9.0, 4.0)])
def test_a_refit_finds_the_mode_under_any_prior(prior):
    data, effect = data_with(3.5), nearly_the_slope(prior)
    problem = Problem(slope, data, [effect]).with_live(["nearly"])
    start = problem.null()
    start[problem.layout.indices(["nearly.by"])] = 2.0
    found = fitting.fit(problem, start, ["nearly"])

    def loss(at):
        mean = at[0] * data["x"] + at[1] * (data["x"] + 0.1 * data["apart"])
        prior_loss = 0.5 * (at[0] / 100) ** 2 - prior.log_prob(at[1])
        return float(0.5 * jnp.sum((data["y"] - mean) ** 2) + prior_loss)

    best = optimize.minimize(loss, [0.7, 2.0], method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-8}).x
    assert found.x[problem.layout.indices(["b", "nearly.by"])] == pytest.approx(best, abs=2e-3)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_what_absorbs_an_effect_does_not_depend_on_units(unit):
    def tilted(t, y=None):
        level = numpyro.sample("level", dist.Normal(0.0, 100.0))
        tilt = numpyro.sample("tilt", dist.Normal(0.0, 100.0 / unit))
        with numpyro.plate("row", len(t)):
            mean = numpyro.deterministic("mean", level + tilt * unit * t)
            numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)

    t = np.linspace(-1, 1, 300)
    effect = Effect(
        "nearly", {"mean": lambda v, p, c: v + p["by"] * (c["t"] + 0.05)}, (Parameter("by", dist.Normal()),)
    )
    y = np.random.default_rng(0).normal(size=300)
    problem = Problem(tilted, {"t": jnp.asarray(t), "y": jnp.asarray(y)}, [effect])
    base = fitting.fit(problem, problem.null())
    seen = view(problem, base, jax.random.key(0), Settings(replicates=100, site_replicates=19), located=False)
    assert seen.screening.absorbed_by == ("tilt",)


def rare(y=None):
    with numpyro.plate("row", 60):
        mean = numpyro.deterministic("mean", jnp.full(60, 0.2))
        numpyro.sample("y", dist.Poisson(mean), obs=y)


def test_all_replicates_tell_how_rare_a_score_is():
    """Two events in one row of rate .2 come once in 57; ninety-nine replicates take it for once in thousands."""
    effect = Effect(
        "first",
        {"mean": lambda value, p, _: value + p["s"] * (jnp.arange(60) == 0)},
        (Parameter("s", dist.HalfNormal(1.0)),),
    )
    y = np.random.default_rng(3).poisson(0.2, 60)
    y[0] = 2
    problem = Problem(rare, {"y": jnp.asarray(y)}, [effect])
    base = fitting.fit(problem, problem.null())
    settings = Settings()
    adjusted = [
        view(problem, base, jax.random.key(k), settings, located=False).screening.adjusted[0]
        for k in range(6)
    ]
    assert sum(p <= settings.level / 2 for p in adjusted) <= 3
