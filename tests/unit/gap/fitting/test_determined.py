"""How well a field's spread is known, against the exact posterior of a hierarchy of normals."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

from dtprob.effects.effect import FIELD, Effect, Parameter
from dtprob.gap.fitting.base import fit_base
from dtprob.gap.fitting.determined import interval_of_spread, shared_weights
from dtprob.gap.fitting.fit import fit
from dtprob.gap.model.problem import Problem
from dtprob.models.declaration import model

LINKS, READINGS, NOISE, SPREAD = 150, 3, 2.0, 1.0


@model(axes={"expected": ("link", "reading")}, cluster="link")
def levels(y=None):
    level = numpyro.sample("level", dist.Normal(0.0, 10.0))
    expected = numpyro.deterministic("expected", level * jnp.ones((LINKS, READINGS)))
    with numpyro.plate("link", LINKS, dim=-2), numpyro.plate("reading", READINGS, dim=-1):
        numpyro.sample("y", dist.Normal(expected, NOISE), obs=y)


def effect(shape):
    return Effect(
        "shadowing",
        {"expected": lambda value, p, _: value + p["scale"] * p[FIELD]},
        (Parameter("scale", dist.HalfNormal(2.0), unit="dB"),),
        kind="variance",
        field_shape=lambda value, _: shape,
    )


def fitted(field, y):
    problem = Problem(levels, {"y": jnp.asarray(y)}, [field])
    base = fit_base(problem, jax.random.key(0))
    wider = problem.with_live([field.name])
    return wider, fit(wider, wider.translate(base.x, problem), [field.name])


def exact_deviation(means, variance):
    """Posterior standard deviation of the spread of normal means, each of this variance about its own, level unknown."""
    s = np.linspace(1e-3, 4.0, 4000)
    total = s**2 + variance
    square = ((means - means.mean()) ** 2).sum()
    log_p = -0.5 * (len(means) - 1) * np.log(total) - 0.5 * square / total
    weight = np.exp(log_p - log_p.max())
    weight /= weight.sum()
    return float(np.sqrt(weight @ s**2 - (weight @ s) ** 2))


@pytest.mark.parametrize(
    ("shape", "axis"), [((LINKS, 1), 1), ((1, READINGS), 0)], ids=["own of each link", "shared by links"]
)
def test_the_spread_is_known_as_its_exact_posterior_says(shape, axis):
    rng = np.random.default_rng(1)
    spread = SPREAD if axis else 30.0  # of three entries only a spread far above the noise is known at all
    y = -60 + spread * rng.normal(size=shape) + NOISE * rng.normal(size=(LINKS, READINGS))
    problem, found = fitted(effect(shape), y)
    low, high = interval_of_spread(problem, found, "shadowing")
    told = (high - low) / (2 * 1.6449)
    if axis:
        assert told == pytest.approx(exact_deviation(y.mean(axis=1), NOISE**2 / READINGS), rel=0.1)
        assert shared_weights(problem, found, "shadowing") == 0.0
    else:
        bounds = found.spread["shadowing"] * np.sqrt(READINGS / stats.chi2.ppf([0.95, 0.05], READINGS))
        assert (low, high) == pytest.approx(tuple(bounds), rel=0.2)
        assert shared_weights(problem, found, "shadowing") == pytest.approx(READINGS, abs=1.1)


def group_shares(group, y=None):
    """Links that each have a level, in groups that may have one, too."""
    with numpyro.plate("link", len(group), dim=-2):
        level = numpyro.sample("level", dist.Normal(0.0, 3.0))
        with numpyro.plate("reading", 4, dim=-1):
            mean = numpyro.deterministic("mean", level + jnp.zeros((len(group), 4)))
            numpyro.sample("y", dist.Normal(mean, 1.0), obs=y)


@pytest.mark.parametrize("true", [1.5, 2.0, 3.0])
def test_the_spread_that_clusters_share_is_that_of_the_largest_marginal_likelihood(true):
    """What each link has of its own is as unknown as it is: held at its mode it hid a spread of half its size."""
    group = np.repeat(np.arange(20), 5)
    rng = np.random.default_rng(2)
    levels = 3.0 * rng.normal(size=100) + true * rng.normal(size=20)[group]
    y = levels[:, None] + rng.normal(size=(100, 4))
    field = Effect(
        "groups",
        {"mean": lambda value, p, context: value + p["scale"] * p["field"][context["group"], None]},
        (Parameter("scale", dist.HalfNormal(5.0)),),
        kind="variance",
        field_shape=lambda value, context: (20,),
        requires=("group",),
    )
    problem = Problem(group_shares, {"group": jnp.asarray(group), "y": jnp.asarray(y)}, [field])
    problem = problem.with_live(["groups"])
    found = fit(problem, problem.null(), ("groups",))
    means = y.reshape(20, 5, 4).mean(axis=(1, 2))
    spreads = np.linspace(0.01, 6, 600)
    variance = spreads[:, None] ** 2 + (9 + 1 / 4) / 5
    best = spreads[np.argmax(stats.norm.logpdf(means, 0, np.sqrt(variance)).sum(axis=1))]
    assert found.spread["groups"] == pytest.approx(best, rel=0.02, abs=0.02)
