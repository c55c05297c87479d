"""Episodes, redrawn parameters, and the PettingZoo forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from dtprob.control import Environment, draw_pool
from dtprob.control.pettingzoo import ParallelNetwork, turn_based
from dtprob.control.policy import aloha
from dtprob.control.rollout import begin, play
from dtprob.errors import InputError
from dtprob.inference import PointMass
from dtprob.models.multi_access import kernel
from dtprob.physical.multi_access import PhysicalKernel
from tests.refused_actions import NO_ACTIONS, check_refused
from tests.unit.control.networks import NETWORK, truth, world

SEND = jnp.ones(4, jnp.int32)


def steps(environment, count, seed=0):
    """The observations and steps of one environment in which all devices always want to send."""
    keys = jax.random.split(jax.random.key(seed), count + 1)
    state, observation = environment.reset(keys[0])

    def one(state, key):
        state, step = environment.step(key, state, SEND)
        return state, (state, step)

    return observation, *jax.lax.scan(one, state, keys[1:])[1]


def test_an_episode_ends_at_the_horizon_and_its_last_observation_is_kept():
    first, _state, step = steps(world(NETWORK, horizon=6), 15)
    assert np.flatnonzero(step.truncated).tolist() == [5, 11]
    assert not step.terminated.any()
    assert np.array_equal(step.final_observation.slot, [1, 2, 3, 4, 5, 6] * 2 + [1, 2, 3])
    assert np.array_equal(step.observation.slot, [1, 2, 3, 4, 5, 0] * 2 + [1, 2, 3])
    for end in (5, 11):
        fresh = jax.tree.map(lambda leaf, end=end: leaf[end], step.observation)
        assert all(np.array_equal(a, b) for a, b in zip(fresh, first, strict=True))
        assert step.final_observation.action[end].tolist() == [1, 1, 1, 1]
        assert np.array_equal(step.final_observation.ack[end], step.slot.delivered[end])
    assert np.asarray(step.final_observation.buffer)[[5, 11]].any()


@pytest.mark.parametrize("transition", [PhysicalKernel.of(NETWORK), kernel(NETWORK.clusters)])
def test_parameters_change_when_they_should(transition):
    never, always = np.eye(5)[:, [0] * 5] * 0, np.eye(5)
    never[:, 0] = 1
    with np.errstate(divide="ignore"):
        pool = {
            "log_arrival": jnp.log(jnp.array([0.0, 0.0, 0.0, 1.0])) * jnp.ones((2, 2, 1, 1)),
            "log_reception": jnp.log(jnp.array([never, always])),
        }
    environment = Environment(transition, pool, horizon=40, redraw=4)
    _, state, step = steps(environment, 160, seed=3)
    used = np.concatenate([[-1], np.asarray(state.draw)[:-1]])
    full = np.arange(160) % 40 > 0  # from the second slot of an episode on, every buffer is full
    works = np.asarray(step.slot.delivered).sum(-1)
    assert set(works[full]) == {0, 4}
    assert np.array_equal(works[full] == 4, used[full] == 1)
    change = np.flatnonzero(np.diff(np.asarray(state.draw))) + 2
    assert set(change % 4) == {0}
    assert len(change) > 5


def test_a_pool_comes_from_any_sampler():
    pool = draw_pool(jax.random.key(0), PointMass(NETWORK.parameters), 3)
    assert pool["log_reception"].shape == (3, 5, 5)
    known = {"rate": np.float32(0.5), "place": np.array([2, 0])}
    kept = draw_pool(jax.random.key(0), PointMass(known), 2, ("rate", "place"))
    assert kept["rate"].dtype == jnp.result_type(float)
    assert jnp.issubdtype(kept["place"].dtype, jnp.integer)
    with pytest.raises(InputError, match="log_arrival"):
        draw_pool(jax.random.key(0), PointMass({"log_reception": np.zeros((5, 5))}), 3)
    with pytest.raises(InputError, match="horizon: expected 1 slot or more"):
        Environment(PhysicalKernel.of(NETWORK), pool, horizon=0)


def test_the_two_kernels_play_alike():
    """Ground truth and twin, written apart, deliver as much under the same parameters and policy."""
    rates = []
    for transition in (PhysicalKernel.of(NETWORK), kernel(NETWORK.clusters)):
        environment = Environment(transition, truth(NETWORK), horizon=10**6)
        policy = aloha(4, 1, 0.5)
        now = begin(jax.random.key(1), environment, policy, 200)
        played = play(jax.random.key(2), environment, policy, now, 300)[1]
        each = np.asarray(played.slot.delivered).sum(-1).mean(0)
        rates.append((each.mean(), each.std() / np.sqrt(len(each))))
    assert abs(rates[0][0] - rates[1][0]) < 4 * np.hypot(rates[0][1], rates[1][1])


@pytest.mark.filterwarnings("ignore:Observation numpy array is all zeros:UserWarning")
@pytest.mark.parametrize("form", ["parallel", "turn_based"])
def test_pettingzoo_accepts_it(form, capsys):
    environment = world(NETWORK, horizon=30, redraw=10)
    if form == "parallel":
        parallel_api_test(ParallelNetwork(environment), num_cycles=80)
        parallel_seed_test(lambda: ParallelNetwork(environment), num_cycles=20)
    else:
        api_test(turn_based(environment), num_cycles=60)
        seed_test(lambda: turn_based(environment), num_cycles=20)


def test_pettingzoo_truncates_and_shows_the_final_observation():
    network = ParallelNetwork(world(NETWORK, horizon=3))
    with pytest.raises(InputError, match="Call reset first"):
        network.step({"device_0": 1})
    seen, _ = network.reset(seed=1)
    assert seen["device_2"].tolist() == [0, 0, 0, 0]
    everyone = dict.fromkeys(network.possible_agents, 1)
    with pytest.raises(InputError, match="none of \\['device_3'\\]"):
        network.step(dict.fromkeys(network.possible_agents[:3], 1))
    for slot in (1, 2, 3):
        seen, reward, terminated, truncated, _ = network.step(everyone)
        assert {row[3] for row in seen.values()} == {slot}
        assert set(truncated.values()) == {slot == 3}
        assert set(terminated.values()) == {False}
        assert len(set(reward.values())) == 1
        assert np.array_equal(network.state(), np.stack(list(seen.values())))
    assert network.agents == []
    assert network.step({}) == ({}, {}, {}, {}, {})


def test_without_a_seed_each_network_has_luck_of_its_own():
    played = []
    for _ in range(2):
        network = ParallelNetwork(world(NETWORK, horizon=60))
        network.reset()
        played.append([network.step(dict.fromkeys(network.agents, 1))[0]["device_0"] for _ in range(50)])
    assert not np.array_equal(*played)


@pytest.mark.parametrize("action", NO_ACTIONS)
def test_actions_that_there_are_not_are_refused(action):
    network = ParallelNetwork(world(NETWORK, horizon=3))
    network.reset(seed=1)
    check_refused(network, action)


def test_devices_sample_actions_of_their_own():
    network = ParallelNetwork(world(NETWORK, horizon=3))
    network.reset(seed=1)
    spaces = [network.action_space(agent) for agent in network.agents]
    assert len({tuple(space.sample() for _ in range(40)) for space in spaces}) == 4
