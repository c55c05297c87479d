"""Distributions that are known by their density and their draws alone: rows, moves and whole diagnoses."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.distributions import constraints

from dtprob.effects import Effect, Parameter
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.observation import whiten
from dtprob.inference import Laplace
from tests.unit.gap.observation.rice import Rice

COUNT = 20_000


class Bell(dist.Normal):
    """A normal distribution, of which nothing but its density and its draws is taken."""


def observed(fn, seed=0):
    return whiten.observation(fn, fn.sample(jax.random.key(seed)), "seen")


def spread_out(low, high, n=COUNT):
    return jnp.linspace(low, high, n)


def test_rows_are_those_of_the_same_distribution_that_is_known():
    loc, scale = spread_out(-3.0, 3.0), spread_out(0.5, 2.0)
    own, known = observed(Bell(loc, scale)), observed(dist.Normal(loc, scale))
    assert own.family.endswith("Bell")
    value = dist.Normal(loc, scale).sample(jax.random.key(1))
    tangent = {"loc": jnp.full(COUNT, 0.3), "scale": jnp.full(COUNT, -0.2)}
    pairs = [(whiten.residual(one, value), whiten.shift(one, tangent)) for one in (own, known)]
    (residual, shift), (exact_residual, exact_shift) = pairs
    np.testing.assert_allclose(residual, exact_residual, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(shift, exact_shift, rtol=1e-6, atol=1e-6)


class Number(dist.NegativeBinomial2):
    """A count."""


@pytest.mark.parametrize(
    "fn",
    [
        Rice(spread_out(0.3, 4.0), spread_out(1.5, 0.6)),
        pytest.param(
            Number(spread_out(0.5, 300.0, 4000), spread_out(1.0, 20.0, 4000)), marks=pytest.mark.study
        ),
        dist.AsymmetricLaplace(spread_out(-9.0, 9.0), spread_out(0.1, 9.0), spread_out(0.5, 2.0)),
        dist.Gompertz(spread_out(0.5, 3.0), spread_out(0.2, 2.0)),
    ],
    ids=lambda fn: type(fn).__name__,
)
def test_residuals_have_mean_zero_and_unit_covariance(fn):
    rows = whiten.residual(observed(fn), fn.sample(jax.random.key(3)))
    error = 4.5 / np.sqrt(rows.shape[1])
    assert np.abs(rows.mean(1)).max() < error
    assert np.abs(np.cov(rows) - np.eye(len(rows))).max() < 2 * error


def test_a_move_shifts_the_first_row_by_its_step_and_stays_where_the_parameter_may_be():
    one = observed(Rice(spread_out(0.5, 4.0, 500), jnp.ones(500)))
    step = jnp.full(500, 1e-4)
    moved = whiten.moved(one, step, spread=False)
    tangent = {n: moved.parameters[n] - one.parameters[n] for n in one.parameters}
    np.testing.assert_allclose(whiten.shift(one, tangent)[0], step, rtol=1e-3)
    far = whiten.moved(one, jnp.full(500, -50.0), spread=False)
    assert float(far.parameters["sight"].min()) > 0


def late(n):
    """Ranges by line of sight or late by an unknown delay."""
    near = dist.Normal(spread_out(10.0, 90.0, n), spread_out(0.3, 1.0, n))
    far = dist.Gamma(spread_out(4.0, 9.0, n), 0.1)
    chance = jnp.stack([spread_out(0.2, 0.9, n), 1 - spread_out(0.2, 0.9, n)], -1)
    return dist.MixtureGeneral(dist.Categorical(chance), [near, far], support=constraints.real)


@pytest.mark.study
def test_rows_of_a_mixture_of_two_families():
    fn = late(4000)
    one = observed(fn)
    value = fn.sample(jax.random.key(5))
    np.testing.assert_allclose(whiten.log_prob(one, value), fn.log_prob(value), rtol=1e-9)
    rows = whiten.residual(one, value)
    error = 4.5 / np.sqrt(4000)
    assert rows.shape == (5, 4000)
    assert np.abs(rows.mean(1)).max() < error
    assert np.abs(np.cov(rows) - np.eye(5)).max() < 3 * error
    replicate = whiten.sample(one, jax.random.key(6))
    assert abs(replicate.mean() - value.mean()) < 4.5 * value.std() * np.sqrt(2 / 4000)


@pytest.mark.study
def test_a_mixture_that_is_known_is_the_same_without_quadratures_of_its_own(monkeypatch):
    parts = dist.Normal(jnp.stack([jnp.zeros(50), spread_out(1.0, 4.0, 50)], -1), jnp.asarray([1.0, 2.0]))
    fn = dist.MixtureSameFamily(dist.Categorical(jnp.asarray([0.7, 0.3])), parts)
    value = fn.sample(jax.random.key(7))
    known = observed(fn)
    monkeypatch.setattr("dtprob.gap.observation.recognise._mixed", lambda _: None)
    own = observed(fn)
    assert own.family != known.family
    near = {n: jnp.full_like(v, 0.1) for n, v in own.parameters.items()}
    told = (whiten.residual(own, value) * whiten.shift(own, near)).sum(0)
    change = {"loc": 0.1, "scale": 0.1, "log_weight": jnp.asarray([0.0, 0.1])}
    same = {n: jnp.broadcast_to(change[n], v.shape) for n, v in known.parameters.items()}
    exact = (whiten.residual(known, value) * whiten.shift(known, same)).sum(0)
    np.testing.assert_allclose(told, exact, rtol=1e-6, atol=1e-8)
    information = [(whiten.shift(o, t) ** 2).sum(0) for o, t in ((own, near), (known, same))]
    np.testing.assert_allclose(*information, rtol=2e-3)


class Falling(Rice):
    """Its values depend on where its parameter is."""

    @constraints.dependent_property(is_discrete=False, event_dim=0)
    def support(self):
        return constraints.greater_than(self.sight)


def test_what_cannot_be_taken_so_is_refused():
    with pytest.raises(InputError, match="support that does not depend"):
        observed(Falling(jnp.ones(3), jnp.ones(3)))


def envelope(distance, hour, seen=None):
    level = numpyro.sample("level", dist.Normal(1.0, 1.0))
    exponent = numpyro.sample("exponent", dist.Normal(1.0, 0.3))
    scatter = numpyro.sample("scatter", dist.LogNormal(0.0, 0.5))
    sight = numpyro.deterministic("sight", jnp.exp(level - exponent * jnp.log(distance)))
    with numpyro.plate("reading", len(distance)):
        numpyro.sample("seen", Rice(sight, scatter), obs=seen)


EFFECTS = [
    Effect(
        "blocked",
        {"sight": lambda v, p, c: v * jnp.exp(-p["nepers"] * (c["hour"] >= 6))},
        (Parameter("nepers", dist.HalfNormal(1.0)),),
    ),
    Effect(
        "far_bend",
        {"sight": lambda v, p, c: v * c["distance"] ** p["more"]},
        (Parameter("more", dist.Normal(0, 0.5)),),
    ),
]


@pytest.mark.study
@pytest.mark.parametrize(("loss", "verdict"), [(0.0, "NO_GAP"), (0.4, "LISTED")])
def test_a_diagnosis_of_envelopes(loss, verdict):
    rng = np.random.default_rng(4)
    hour, distance = np.repeat(np.arange(12), 40), rng.uniform(1.0, 3.0, 480)
    sight = np.exp(1.2 - np.log(distance) - loss * (hour >= 6))
    seen = np.abs(sight + 0.4 * (rng.normal(size=480) + 1j * rng.normal(size=480)))
    data = {"distance": distance, "hour": hour, "seen": seen}
    found = diagnose(envelope, data, EFFECTS, cluster="hour", engine=Laplace(), key=jax.random.key(0))
    assert found.verdict == verdict
    if loss:
        assert found.causes[0].effects == ("blocked",)
