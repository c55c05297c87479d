"""Laws at an end of their parameters: what is certain tells nothing, has its own density, and can be impossible."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.fitting.fit import fit
from dtprob.gap.model.problem import Problem
from dtprob.gap.observation import whiten

N = 40
RNG = np.random.default_rng(0)
TIME = np.where(np.arange(N) % 4 > 0, RNG.uniform(1.0, 3.0, N), 0.0)
"""For a quarter of the rows nothing was listened to."""

# family: (make distribution, parameter at its end, value that is certain there, slope of its log density)
CERTAIN = {
    "Poisson": (dist.Poisson, 0.0, 0, -1.0),
    "Bernoulli": (dist.Bernoulli, 0.0, 0, -1.0),
    "Bernoulli at 1": (dist.Bernoulli, 1.0, 1, 1.0),
    "Binomial": (lambda p: dist.Binomial(5, p), 0.0, 0, -5.0),
    "Binomial at 1": (lambda p: dist.Binomial(5, p), 1.0, 5, 5.0),
    "Geometric": (dist.Geometric, 1.0, 0, 1.0),
    "ZeroInflated": (lambda r: dist.ZeroInflatedDistribution(dist.Poisson(r), gate=0.2), 0.0, 0, -0.8),
}


def log_prob(make, at, value):
    return jnp.sum(whiten.log_prob(whiten.observation(make(at), value, "y"), value))


@pytest.mark.parametrize("family", CERTAIN)
def test_a_certain_outcome_has_its_density_and_tells_nothing(family):
    make, end, value, slope = CERTAIN[family]
    value = jnp.asarray([value])
    at = jnp.asarray([end])
    density = jax.jit(lambda p: log_prob(make, p, value))
    assert float(density(at)) == pytest.approx(0.0, abs=1e-12)
    assert float(jax.grad(density)(at)[0]) == pytest.approx(slope)
    hessian = jax.jvp(jax.grad(density), (at,), (jnp.ones(1),))[1]
    assert np.isfinite(np.asarray(hessian)).all()
    observed, tangent = jax.jvp(
        lambda p: whiten.observation(make(p), value, "y").parameters, (at,), (jnp.ones(1),)
    )
    observation = whiten.observation(make(at), value, "y")
    assert not np.asarray(whiten.residual(observation, value)).any()
    rows = np.asarray(whiten.shift(whiten.Observation(observation.family, observed), tangent))
    assert not rows.any()
    assert not np.asarray(whiten.impossible(observation, value)).any()
    other = jnp.where(value > 0, value - 1, value + 1)
    is_gated = family == "ZeroInflated"
    assert np.asarray(whiten.impossible(observation, other)).all() or is_gated


@pytest.mark.parametrize("family", [f for f in CERTAIN if f != "ZeroInflated"])
def test_densities_are_those_of_numpyro_off_the_end(family):
    make, _, _, _ = CERTAIN[family]
    value, at = jnp.asarray([0, 1, 1]), jnp.asarray([0.3, 0.6, 0.9])
    observed = whiten.observation(make(at), value, "y")
    np.testing.assert_allclose(
        whiten.log_prob(observed, value), make(at).log_prob(value), rtol=1e-9, atol=1e-12
    )


def test_an_angle_that_may_be_anything():
    """Rows are those of the uniform law, sqrt 2 sin and sqrt 2 cos; its location tells nothing, its concentration half."""
    value = jnp.asarray([0.4, 2.0, -3.0])
    parameters = {"loc": jnp.full(3, 0.1), "concentration": jnp.zeros(3)}
    observed = whiten.Observation("VonMises", parameters)
    rows = np.sqrt(2.0) * np.stack([np.sin(value - 0.1), np.cos(value - 0.1)])
    np.testing.assert_allclose(whiten.residual(observed, value), rows, rtol=1e-12)
    one = {n: jnp.ones(3) for n in parameters}
    np.testing.assert_allclose(whiten.shift(observed, one), [[0.0] * 3, [0.5**0.5] * 3], rtol=1e-12)
    near = whiten.Observation("VonMises", {**parameters, "concentration": jnp.full(3, 0.0099)})
    beyond = whiten.Observation("VonMises", {**parameters, "concentration": jnp.full(3, 0.0101)})
    np.testing.assert_allclose(
        whiten.residual(near, value), whiten.residual(beyond, value), rtol=1e-3, atol=1e-3
    )
    for spread in (False, True):
        moved = whiten.moved(observed, jnp.ones(3), spread=spread)
        assert all(np.isfinite(np.asarray(v)).all() for v in moved.parameters.values())


@pytest.mark.study
def test_a_part_of_a_mixture_that_never_comes():
    """The mixture is its other part, whatever this one is."""
    value = jnp.asarray([0.3, -1.0, 2.0])

    def mixed(chance):
        parts = dist.Normal(jnp.array([0.0, 5.0]), 1.0)
        return dist.MixtureSameFamily(dist.Categorical(jnp.stack([1 - chance, chance])), parts)

    def told(chance):
        return whiten.observation(mixed(chance), value, "y").parameters

    observed, tangent = jax.jvp(told, (jnp.zeros(()),), (jnp.ones(()),))
    observed = whiten.Observation("Mixture Normal", observed)
    alone = dist.Normal(0.0, 1.0).log_prob(value)
    np.testing.assert_allclose(whiten.log_prob(observed, value), alone, rtol=1e-6)
    rows, shift = whiten.residual(observed, value), whiten.shift(observed, tangent)
    assert np.isfinite(np.asarray(rows)).all()
    assert np.isfinite(np.asarray(shift)).all()
    slope = jax.grad(lambda c: jnp.sum(whiten.log_prob(whiten.observation(mixed(c), value, "y"), value)))(0.0)
    assert np.isfinite(slope)


def packets(time, heard=None):
    rate = numpyro.sample("rate", dist.LogNormal(0.0, 1.0))
    with numpyro.plate("row", len(time)):
        expected = numpyro.deterministic("expected", rate * time)
        numpyro.sample("heard", dist.Poisson(expected), obs=heard)


def test_rows_that_nothing_was_listened_to_change_no_fit():
    heard = RNG.poisson(2.0 * TIME)
    fits = []
    for rows in (slice(None), TIME > 0):
        problem = Problem(packets, {"time": jnp.asarray(TIME[rows]), "heard": jnp.asarray(heard[rows])}, [])
        fits.append(fit(problem, np.zeros(1)))
    assert fits[0].x == pytest.approx(fits[1].x)
    assert fits[0].log_posterior == pytest.approx(fits[1].log_posterior)


def test_a_count_where_none_can_be_is_named():
    heard = RNG.poisson(2.0 * TIME)
    heard[8] = 3
    data = {"time": jnp.asarray(TIME), "heard": jnp.asarray(heard)}
    with pytest.raises(
        InputError, match=r"data heard: .* got 3 at \[8\] where it has Poisson of rate 0\. Leave"
    ):
        diagnose(packets, data, key=jax.random.key(0))


def test_an_outcome_that_is_impossible_is_named():
    """NumPyro gives it a density all the same."""

    def outcomes(time, heard=None):
        chance = numpyro.sample("chance", dist.Beta(2.0, 2.0))
        with numpyro.plate("row", len(time)):
            expected = numpyro.deterministic("expected", jnp.where(time > 0, chance, 0.0))
            numpyro.sample("heard", dist.Bernoulli(expected), obs=heard)

    heard = np.where(TIME > 0, RNG.binomial(1, 0.5, N), 0)
    heard[8] = 1
    data = {"time": jnp.asarray(TIME), "heard": jnp.asarray(heard)}
    with pytest.raises(InputError, match=r"got 1 at \[8\] where it has BernoulliProbs of probs 0\. Leave"):
        diagnose(outcomes, data, key=jax.random.key(0))
