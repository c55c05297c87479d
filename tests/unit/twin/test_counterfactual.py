"""Counterfactuals: the logged policy gives the logged episode; noise given a log has the noise's law; average effects."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from dtprob.data import NetworkLog
from dtprob.errors import InputError
from dtprob.inference import PointMass
from dtprob.inference.exact import DirichletTables
from dtprob.models.multi_access import kernel, priors, records, window_counts
from dtprob.models.multi_access.abduction import Transition, abduct
from dtprob.twin.counterfactual import Arm, Effect, average_effect, transitions, what_if
from dtprob.twin.rollout import random_access, throughput
from tests.small_network import CLUSTERS, simulate

SYSTEM = kernel(CLUSTERS)


@pytest.fixture(scope="module")
def log():
    return simulate(80, 20)


@pytest.fixture(scope="module")
def posterior(log):
    arguments = records(log, clusters=CLUSTERS)
    counts = {name: value.sum(axis=0) for name, value in window_counts(arguments).items()}
    return DirichletTables(priors(arguments["clusters"], 0.5)).updated(counts)


def test_the_logged_actions_give_back_the_logged_episode(log, posterior):
    slots = what_if(jax.random.key(0), SYSTEM, posterior, log, draws=30)
    assert np.array_equal(slots.delivered, np.broadcast_to(log.ack, (30, 80, 4)))
    lost = (log.buffer + log.arrival - log.ack) > 1
    assert np.array_equal(slots.overflow, np.broadcast_to(lost, (30, 80, 4)))


def test_another_policy_changes_what_it_touches_only(log, posterior):
    action = jnp.asarray(log.action).at[40:].set(0)

    def silent_later(key, state):
        return action[state.slot]

    slots = what_if(jax.random.key(1), SYSTEM, posterior, log, policy=silent_later, draws=10)
    assert np.array_equal(slots.delivered[:, :40], np.broadcast_to(log.ack[:40], (10, 40, 4)))
    assert not np.any(slots.delivered[:, 40:])


@pytest.mark.study
def test_noise_given_what_happened_is_uniform_over_slots(posterior):
    """Noise drawn, slot run, noise drawn anew given the slot: its law is the prior's. Fails once in 10^4 keys."""
    parameters = {
        name: jnp.asarray(value[0]) for name, value in posterior.sample(jax.random.key(2), 1).items()
    }
    state = SYSTEM.initial()._replace(buffer=jnp.array([1, 1, 1, 0], jnp.int32))
    action = jnp.array([1, 1, 1, 1], jnp.int32)

    def again(key):
        draw, anew = jax.random.split(key)
        after, slot = SYSTEM.step(draw, parameters, state, action)
        happened = Transition(state, action, slot.delivered, after.arrival)
        noise, could = abduct(SYSTEM, anew, parameters, happened)
        return jnp.concatenate([noise.arrival, noise.reception[None], noise.rank]), could

    values, could = jax.jit(jax.vmap(again))(jax.random.split(jax.random.key(3), 4000))
    assert np.all(could)
    for column in np.asarray(values).T:
        assert stats.kstest(column, "uniform").pvalue > 1e-4 / 7
    correlation = np.corrcoef(np.asarray(values).T) - np.eye(7)
    assert np.abs(correlation).max() < 5 / np.sqrt(4000)


def test_an_episode_that_cannot_happen_is_named(log, posterior):
    impossible = {name: np.where(value[0] > -1e9, value[0], -np.inf) for name, value in posterior.sample(
        jax.random.key(4), 1).items()}  # fmt: skip
    impossible["log_arrival"] = np.log(np.broadcast_to([1.0, 1e-300, 1e-300, 1e-300], (2, 1, 4)))
    slot = int(np.flatnonzero(log.arrival.any(axis=1))[0])
    with pytest.raises(InputError, match=f"slots that can happen, got slot {slot} under draw 0"):
        what_if(jax.random.key(0), SYSTEM, PointMass(impossible), log, draws=2)


@pytest.mark.study
def test_the_average_effect_of_silence_is_minus_the_throughput(posterior):
    arms = Arm(random_access(4, 0.25)), Arm(random_access(4, 0.0))
    given = {"metric": throughput, "horizon": 50, "draws": 20, "episodes": 4}
    found = average_effect(
        jax.random.key(5), SYSTEM, posterior, baseline=arms[0], alternative=arms[1], **given
    )
    low, high = found.interval()
    assert low <= found.average <= high < 0
    same = average_effect(
        jax.random.key(5), SYSTEM, posterior, baseline=arms[0], alternative=arms[0], **given
    )
    assert not np.any(same.differences)


def test_the_effect_of_another_network(posterior):
    def perfect(parameters):
        count = jnp.arange(5)
        return {**parameters, "log_reception": jnp.where(count == count[:, None], 0.0, -jnp.inf)}

    base = Arm(random_access(4, 1.0))
    found = average_effect(
        jax.random.key(6), SYSTEM, posterior, baseline=base, alternative=base._replace(change=perfect),
        metric=throughput, horizon=100, draws=10, episodes=4,
    )  # fmt: skip
    assert found.interval()[0] > 0.2


def test_a_change_to_tables_of_another_network_is_refused(log, posterior):
    """Rows that a smaller table lacks would be clamped to its last, without a word."""

    def smaller(parameters):
        return {**parameters, "log_reception": parameters["log_reception"][:3, :3]}

    arm, larger = Arm(random_access(4, 0.3)), kernel([[0, 1], [2, 3], [4, 5]])
    changed = arm._replace(change=smaller), "draws of 'log_reception'"
    replaced = Arm(random_access(6, 0.3), kernel=larger), "draws of 'log_arrival'"
    for other, told in (changed, replaced):
        with pytest.raises(InputError, match=told):
            average_effect(
                jax.random.key(0), SYSTEM, posterior, baseline=arm, alternative=other,
                metric=throughput, horizon=5, draws=2, episodes=2,
            )  # fmt: skip
    with pytest.raises(InputError, match="draws of 'log_reception'"):
        what_if(jax.random.key(0), SYSTEM, posterior, log, change=smaller, draws=2)


def test_transitions_carry_the_slot_before(log):
    happened = transitions(log)
    assert np.array_equal(happened.state.ack[1:], log.ack[:-1])
    assert not np.any(np.asarray(happened.state.arrival[0]))


def test_several_episodes_are_not_taken_for_one(posterior):
    with pytest.raises(InputError, match="episode: expected the slots of one, got those of 2"):
        what_if(jax.random.key(0), SYSTEM, posterior, simulate(12, 3, episodes=2), draws=3)


def idle(slots, packets, first=0):
    """Four devices whose buffers hold some packets, and in which nothing happens."""
    nothing = np.zeros((slots, 4), int)
    return NetworkLog(
        episode=np.zeros(slots, int),
        slot=np.arange(first, first + slots),
        buffer=nothing + packets,
        action=nothing,
        ack=nothing,
        arrival=nothing,
    )


def test_an_episode_of_another_network_is_refused(posterior):
    """Run again with smaller buffers, or with other devices, it would not be the logged one."""
    with pytest.raises(InputError, match="buffer_0: expected 1 packets, as capacity 1 leaves, got 2"):
        what_if(jax.random.key(0), SYSTEM, posterior, idle(5, 2), draws=3)
    what_if(jax.random.key(0), kernel(CLUSTERS, 2), posterior, idle(5, 2), draws=3)
    with pytest.raises(InputError, match="expected 2 devices, as in the network, got 4"):
        what_if(jax.random.key(0), kernel(((0, 1),)), posterior, idle(5, 1), draws=3)


@pytest.mark.study
def test_a_policy_meets_the_slots_of_the_log(posterior):
    """A log that begins in slot 3 of its episode is in another slot of a frame than one that begins in slot 0."""

    def in_the_fifth(key, state):
        return jnp.full(4, state.slot == 5)

    slots = what_if(jax.random.key(0), SYSTEM, posterior, idle(5, 1, 3), policy=in_the_fifth, draws=40)
    assert np.asarray(slots.collision).any(axis=0).tolist() == [False, False, True, False, False]


def test_credible_limits_are_those_of_the_average_and_not_of_few_episodes():
    random = np.random.default_rng(0)
    effects = random.normal(size=(4000, 1)) + 4 * random.normal(size=(4000, 4))
    np.testing.assert_allclose(Effect(effects).interval(), (-1.645, 1.645), atol=0.25)


@pytest.mark.parametrize("wrong", [{"horizon": 0}, {"draws": 0}, {"episodes": 1}])
def test_an_effect_of_nothing_is_refused(posterior, wrong):
    arm = Arm(random_access(4, 0.3))
    settings = {"horizon": 5, "draws": 2, "episodes": 2, **wrong}
    with pytest.raises(InputError, match=f"{next(iter(wrong))}: expected"):
        average_effect(
            jax.random.key(0), SYSTEM, posterior, baseline=arm, alternative=arm, metric=throughput, **settings
        )
