"""Effects on what a model draws: its own value is rewritten, and what was drawn keeps its prior under another name."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.contrib.control_flow import scan
from numpyro.infer.util import log_density
from scipy import stats

from dtprob.effects import Effect, Parameter
from dtprob.effects.library import check_sites
from dtprob.effects.rewriting import with_effects
from dtprob.errors import InputError
from dtprob.gap.model.problem import Problem
from dtprob.models.declaration import declare
from dtprob.testing import check_effect
from dtprob.testing.contract import ContractError

LINKS, READINGS = 6, 5


def loud(far, y=None):
    """Each link has its own noise."""
    with numpyro.plate("a link's noise", LINKS):
        noise = numpyro.sample("noise", dist.LogNormal(0.0, 0.5))
    with numpyro.plate("link", LINKS, dim=-2), numpyro.plate("reading", READINGS, dim=-1):
        mean = numpyro.deterministic("mean", 0.0 * far[:, None] + jnp.zeros((LINKS, READINGS)))
        numpyro.sample("y", dist.Normal(mean, noise[:, None]), obs=y)


def walk(y=None):
    def step(level, given):
        level = numpyro.sample("level", dist.Normal(level, 0.3))
        numpyro.sample("y", dist.Normal(level, 1.0), obs=given)
        return level, level

    scan(step, 0.0, y, length=READINGS)


LOUDER = Effect(
    "louder",
    {"noise": lambda noise, p, context: noise * jnp.exp(p["more"] * context["far"])},
    (Parameter("more", dist.Normal(0.0, 1.0)),),
    physics="Far links are louder.",
)


@pytest.fixture(name="data")
def _data():
    far = np.arange(LINKS) % 2.0
    return {"far": far, "y": np.random.default_rng(0).normal(size=(LINKS, READINGS)) * np.exp(far)[:, None]}


def test_its_density_is_the_closed_one(data):
    drawn = np.random.default_rng(1).lognormal(size=LINKS)
    values = {"noise_drawn": drawn, "louder.more": 0.7}
    found, trace = log_density(with_effects(loud, [LOUDER]), (), data, values)
    acting = drawn * np.exp(0.7 * data["far"])
    told = stats.lognorm(0.5).logpdf(drawn).sum() + stats.norm.logpdf(0.7)
    told += stats.norm(0.0, acting[:, None]).logpdf(data["y"]).sum()
    assert float(found) == pytest.approx(told, rel=1e-10)
    np.testing.assert_allclose(trace["noise"]["value"], acting, rtol=1e-12)


def test_a_site_that_no_effect_rewrites_keeps_its_name(data):
    other = Effect(
        "up", {"mean": lambda mean, p, _: mean + p["by"]}, (Parameter("by", dist.Normal(0.0, 1.0)),)
    )
    assert set(declare(with_effects(loud, [other]), data).latent) == {"up.by", "noise"}
    assert "noise" in declare(with_effects(loud, [LOUDER]), data).deterministic


def test_states_of_a_scan_are_drawn_apart_too():
    raised = Effect(
        "raised", {"level": lambda level, p, _: level + p["by"]}, (Parameter("by", dist.Normal(0.0, 1.0)),)
    )
    y = np.random.default_rng(2).normal(size=READINGS)
    drawn = np.linspace(-1.0, 1.0, READINGS)
    values = {"level_drawn": jnp.asarray(drawn), "raised.by": 0.4}
    found, _ = log_density(with_effects(walk, [raised]), (), {"y": y}, values)
    acting = drawn + 0.4
    told = stats.norm(np.append(0.0, acting[:-1]), 0.3).logpdf(drawn).sum() + stats.norm.logpdf(0.4)
    assert float(found) == pytest.approx(told + stats.norm(acting, 1.0).logpdf(y).sum(), rel=1e-10)


def test_a_problem_and_the_contract_take_it(data):
    check_effect(LOUDER, loud, data)
    problem = Problem(loud, data, [LOUDER])
    assert set(problem.own) == {"noise_drawn"}  # each link's, whatever the plate is called
    live, x = problem.with_live(["louder"]), problem.with_live(["louder"]).null()
    index = live.layout["louder.more"].offset
    step = np.eye(len(x))[index] * 1e-5
    slope = live.compiled.slope(x, np.ones(LINKS))[index]
    up, down = (live.compiled.evaluate(x + s * step).likelihood.sum() for s in (1, -1))
    assert slope == pytest.approx((up - down) / 2e-5, rel=1e-6)


def test_a_reference_tells_of_what_is_drawn_by_the_sites_own_name(data):
    class Earlier:
        def sample(self, key, n):
            return {"noise": np.exp(1.0 + 0.1 * jax.random.normal(key, (n, LINKS)))}

    def shared(far, y=None):
        noise = numpyro.sample("noise", dist.LogNormal(0.0, 0.5).expand([LINKS]).to_event(1))
        with numpyro.plate("link", LINKS, dim=-2), numpyro.plate("reading", READINGS, dim=-1):
            numpyro.sample("y", dist.Normal(0.0 * far[:, None], noise[::-1, None]), obs=y)

    known = Problem(shared, data, [LOUDER], reference=Earlier()).known
    np.testing.assert_allclose(known["noise_drawn",][0], 1.0, atol=0.02)


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        (Effect("a", {"y": LOUDER.rewrites["noise"]}, LOUDER.parameters), "`distributions`, not `rewrites`"),
        (
            Effect("b", {}, LOUDER.parameters, distributions={"mean": lambda fn, _p, _context: fn}),
            "`rewrites`, not `distributions`",
        ),
    ],
)
def test_what_is_neither_a_value_nor_a_distribution_is_refused(effect, said, data):
    with pytest.raises(InputError, match=said):
        check_sites(effect, declare(loud, data).sites)
    with pytest.raises(InputError, match=said):
        Problem(loud, data, [effect])


def test_the_contract_refuses_an_observed_value(data):
    with pytest.raises(ContractError, match="not rewrites"):
        check_effect(
            Effect("a", {"y": lambda y, p, _: y + p["more"]}, LOUDER.parameters, physics="No."), loud, data
        )


def test_a_scalar_that_would_become_a_vector_is_refused_with_a_remedy(data):
    def one(far, y=None):
        noise = numpyro.sample("noise", dist.LogNormal(0.0, 0.5))
        with numpyro.plate("link", LINKS, dim=-2), numpyro.plate("reading", READINGS, dim=-1):
            numpyro.sample("y", dist.Normal(0.0 * far[:, None], noise), obs=y)

    with pytest.raises(InputError, match=r"with 0 axes, got 1.*noise \* jnp.ones\(\(6,\)\)"):
        Problem(one, data, [LOUDER]).float_sites  # noqa: B018
