"""A network that changes as it goes: PettingZoo accepts it, and it delivers what the exact averages say."""

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from dtprob.errors import InputError
from dtprob.physical.multi_access import Network, average, chain, tdma
from dtprob.physical.multi_access.changing import ChangingNetwork, changing_network
from tests.refused_actions import NO_ACTIONS, check_refused

PAIRS = ((0, 1), (2, 3))


def test_pettingzoo_accepts_it(capsys):
    parallel_api_test(changing_network(disconnect=[[40, 2]], horizon=30), num_cycles=100)
    parallel_seed_test(lambda: changing_network(disconnect=[[40, 2]], horizon=30), num_cycles=50)
    assert "Passed" in capsys.readouterr().out


def test_throughput_before_and_after_is_the_exact_one():
    environment = changing_network(disconnect=[[6000, 1]])
    environment.reset(seed=3)
    delivered = []
    for slot in range(12_000):
        turn = {agent: int(i in PAIRS[slot % 2]) for i, agent in enumerate(environment.agents)}
        infos = environment.step(turn)[4]
        delivered.append(sum(info["delivered"] for info in infos.values()))
    for network, got in (
        (Network.reference(), delivered[:6000]),
        (Network.reference().without(1), delivered[6000:]),
    ):
        expected = average(chain(network), tdma(network, PAIRS)).throughput
        blocks = np.reshape(got, (60, 100)).mean(axis=1)
        assert abs(np.mean(got) - expected) < 4 * blocks.std(ddof=1) / np.sqrt(60)


def test_a_silent_device_takes_nothing_from_the_others():
    network, silent = Network.reference(), Network.reference().without(1)
    np.testing.assert_allclose(silent.arrival[0, 0], [0.6, 0, 0.4, 0])
    np.testing.assert_allclose(silent.arrival[1], network.arrival[1])
    np.testing.assert_allclose(network.arrival[0, 0], [0.2, 0.4, 0.4, 0])


def test_a_change_outlasts_the_episode_and_not_the_seed():
    environment = changing_network(disconnect=[[20, 0], [20 + 1, 1]], horizon=30)
    environment.reset(seed=0)
    for _ in range(30):
        seen = environment.step(dict.fromkeys(environment.agents, 0))[0]
    assert environment.agents == []
    assert seen["device_0"][3] == 30
    environment.reset()
    for _ in range(29):
        seen = environment.step(dict.fromkeys(environment.agents, 0))[0]
    assert seen["device_0"][0] == 0
    environment.reset(seed=0)
    for _ in range(15):
        seen = environment.step(dict.fromkeys(environment.agents, 0))[0]
    assert seen["device_0"][0] == 1


@pytest.mark.parametrize("stages", [[], [(1, Network.reference())], [(0, Network.reference())] * 2])
def test_stages_that_cannot_be_are_refused(stages):
    with pytest.raises(InputError, match="slots that rise from 0"):
        ChangingNetwork(stages)


def test_other_devices_are_refused():
    with pytest.raises(InputError, match="the same devices"):
        ChangingNetwork([(0, Network.reference()), (5, Network.pairs(3))])
    for actions in ({"device_0": 1}, {}):
        with pytest.raises(InputError, match="an episode under way"):
            changing_network().step(actions)


def test_an_episode_that_is_over_takes_no_actions():
    environment = changing_network(horizon=1)
    environment.reset(seed=0)
    environment.step(dict.fromkeys(environment.agents, 1))
    assert environment.step({}) == ({}, {}, {}, {}, {})
    with pytest.raises(InputError, match="an episode under way"):
        environment.step(dict.fromkeys(environment.possible_agents, 1))


def test_without_a_seed_each_network_has_luck_of_its_own():
    played = []
    for _ in range(2):
        network = changing_network()
        network.reset()
        played.append([network.step(dict.fromkeys(network.agents, 1))[0]["device_0"] for _ in range(50)])
    assert not np.array_equal(*played)


@pytest.mark.parametrize("action", NO_ACTIONS)
def test_actions_that_there_are_not_are_refused(action):
    network = changing_network()
    network.reset(seed=1)
    check_refused(network, action)


def test_devices_sample_actions_of_their_own():
    network = changing_network()
    network.reset(seed=1)
    spaces = [network.action_space(agent) for agent in network.agents]
    assert len({tuple(space.sample() for _ in range(40)) for space in spaces}) == 4
