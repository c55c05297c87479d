"""What a slot is expected to tell: closed forms against quadrature, draws against closed forms, the chain rule."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from dtprob.control import Counts, DirichletInformation, SampledInformation
from dtprob.control.information import dirichlet_information, sampled_information
from dtprob.inference.exact import DirichletTables

CLUSTERS = ((0, 1), (2, 3))
ARRIVAL = np.array([[[1.5, 2.0, 0.7, 0.4]], [[3.0, 0.5, 0.5, 1.0]]])
RECEPTION = np.tril(np.full((5, 5), 0.8)) + np.diag([0.0, 2.0, 1.0, 0.0, 0.0])


def entropy(p):
    return -np.sum(np.where(p > 0, p * np.log(np.where(p > 0, p, 1.0)), 0.0), axis=0)


@pytest.mark.parametrize(("a", "b"), [(1.0, 1.0), (0.5, 2.5), (6.0, 3.0)])
def test_two_outcomes_by_quadrature(a, b):
    inside = integrate.quad(lambda p: stats.beta.pdf(p, a, b) * entropy(np.array([p, 1 - p])), 0, 1)[0]
    mean = a / (a + b)
    expected = entropy(np.array([mean, 1 - mean])) - inside
    got = dirichlet_information(jnp.array([a, 0.0, b]))
    assert float(got) == pytest.approx(expected, rel=2e-4)


def test_a_row_that_is_known_tells_nothing():
    assert float(dirichlet_information(jnp.array([0.0, 3.0]))) == pytest.approx(0.0, abs=1e-6)
    assert float(dirichlet_information(jnp.array([4e5, 6e5]))) < 1e-5


def test_draws_agree_with_the_closed_form():
    alpha = np.array([1.5, 2.0, 0.7, 0.4])
    drawn = np.random.default_rng(0).dirichlet(alpha, 40_000)
    got = sampled_information(jnp.full(40_000, 1 / 40_000), jnp.log(jnp.asarray(drawn)))
    error = 4 * entropy(drawn.T).std() / 200
    assert abs(float(got) - float(dirichlet_information(jnp.asarray(alpha)))) < error


def slots(count):
    """Slots as the kernels tell them: state before, action, state after, deliveries."""
    rng = np.random.default_rng(1)
    for _ in range(count):
        buffer, action, arrival = (jnp.asarray(rng.integers(0, 2, 4)) for _ in range(3))
        sends = np.flatnonzero(np.asarray(buffer * action))
        delivered = np.zeros(4, int)
        delivered[sends[: rng.integers(0, len(sends) + 1)]] = 1
        before = SimpleNamespace(buffer=buffer, arrival=jnp.zeros(4, int))
        after = SimpleNamespace(arrival=arrival)
        yield before, action, after, SimpleNamespace(delivered=jnp.asarray(delivered))


def test_an_episodes_outcomes_are_remembered():
    """After each slot the counts have grown by its outcome, and the next gain is that of the counts then."""
    reward = DirichletInformation(Counts(jnp.asarray(ARRIVAL), jnp.asarray(RECEPTION)), CLUSTERS)
    memory, arrival, reception = reward.initial(), ARRIVAL.copy(), RECEPTION.copy()
    for before, action, after, slot in slots(6):
        senders = int(jnp.sum(before.buffer * action))
        expected = dirichlet_information(jnp.asarray(reception[senders])) + jnp.sum(
            dirichlet_information(jnp.asarray(arrival[:, 0]))
        )
        memory, gain = reward(memory, before, action, after, slot)
        assert float(gain) == pytest.approx(float(expected), rel=1e-5)
        joint = np.asarray(after.arrival).reshape(2, 2) @ [2, 1]
        arrival[[0, 1], 0, joint] += 1
        reception[senders, int(slot.delivered.sum())] += 1
    np.testing.assert_allclose(memory.arrival, arrival, rtol=1e-6)
    np.testing.assert_allclose(memory.reception, reception, rtol=1e-6)


@pytest.mark.study
def test_draws_reweighted_by_an_episode_agree_with_its_counts():
    draws = 20_000
    tables = DirichletTables({"log_arrival": ARRIVAL, "log_reception": RECEPTION})
    pool = {name: jnp.asarray(each) for name, each in tables.sample(jax.random.key(0), draws).items()}
    closed = DirichletInformation(Counts(jnp.asarray(ARRIVAL), jnp.asarray(RECEPTION)), CLUSTERS)
    sampled = SampledInformation(pool, CLUSTERS)
    exact, weighted = closed.initial(), sampled.initial()
    for before, action, after, slot in slots(4):
        exact, expected = closed(exact, before, action, after, slot)
        effective = 1 / float(jnp.sum(jax.nn.softmax(weighted) ** 2))
        weighted, got = sampled(weighted, before, action, after, slot)
        # Three rows, whose entropies are at most ln 5 each; four standard errors of their weighted means.
        assert abs(float(got) - float(expected)) < 4 * 3 * 0.8 / np.sqrt(effective)
