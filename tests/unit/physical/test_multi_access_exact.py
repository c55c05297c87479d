"""Exact solutions: the known numbers of the reference network, and what must hold for any."""

import dataclasses

import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.physical.multi_access import (
    Network,
    aloha,
    average,
    chain,
    improve,
    optimum,
    reception,
    slopes,
    tdma,
)

NETWORK = Network.reference()
PAIRS, ACROSS, TURNS = [[0, 1], [2, 3]], [[0, 2], [1, 3]], [[0], [1], [2], [3]]


@pytest.fixture(scope="module")
def reference():
    return chain(NETWORK)


def remembering(memory):
    """The reference network, whose traffic depends on the last arrivals as much as `memory` says."""
    after = np.array(
        [[0.1, 0.45, 0.45, 0.0], [0.3, 0.1, 0.6, 0.0], [0.3, 0.6, 0.1, 0.0], [0.2, 0.4, 0.4, 0.0]]
    )
    arrival = np.tile((1 - memory) * NETWORK.arrival[0] + memory * after, (2, 1, 1))
    return dataclasses.replace(NETWORK, arrival=arrival)


def test_the_best_central_control():
    for remembers in (False, True):
        found = optimum(chain(NETWORK, remembers_ack=remembers))
        assert found.averages.throughput == pytest.approx(1.1624, abs=5e-5)
        assert found.averages.overflow == pytest.approx(0.1094, abs=5e-5)


@pytest.mark.parametrize(
    ("frame", "throughput", "overflow"),
    [(PAIRS, 1.0598, 0.1351), (ACROSS, 1.0229, 0.1443), (TURNS, 0.8704, 0.1824)],
)
def test_time_slots(reference, frame, throughput, overflow):
    found = average(reference, tdma(NETWORK, frame))
    assert found.throughput == pytest.approx(throughput, abs=5e-5)
    assert found.overflow == pytest.approx(overflow, abs=5e-5)


def test_random_access(reference):
    quarter = average(reference, aloha(NETWORK, 0.25))
    assert quarter.throughput == pytest.approx(0.5882, abs=5e-5)
    assert quarter.overflow == pytest.approx(0.2530, abs=5e-5)
    grid = np.arange(0.50, 0.585, 0.01)
    rates = [average(reference, aloha(NETWORK, p)).throughput for p in grid]
    assert max(rates) == pytest.approx(0.7786, abs=5e-5)
    assert grid[np.argmax(rates)] == pytest.approx(0.54, abs=0.011)


@pytest.mark.parametrize("network", [NETWORK, remembering(0.9), dataclasses.replace(NETWORK, capacity=2)])
def test_what_arrives_is_delivered_or_lost(network):
    found = optimum(chain(network, remembers_ack=False)).averages
    one = chain(network, remembers_ack=False)
    assert 0 < found.throughput < 1.2
    if network.arrival.shape[1] == 1:
        assert found.throughput + network.devices * found.overflow == pytest.approx(1.6, abs=1e-9)
    assert np.allclose(one.arrivals.sum(axis=1), 1)
    assert np.allclose(one.success.sum(axis=1), 1)


def test_memory_that_changes_nothing_changes_nothing():
    found = optimum(chain(remembering(0.0), remembers_ack=False)).averages
    assert found.throughput == pytest.approx(1.1624, abs=5e-5)


def test_more_room_delivers_more():
    rates = [
        optimum(chain(dataclasses.replace(NETWORK, capacity=c), remembers_ack=False)).averages.throughput
        for c in (1, 2)
    ]
    assert rates[0] < rates[1] < 1.2


def test_a_lone_device_by_hand():
    """Arrivals 1/2, sends at once, always heard: one slot in two delivers, nothing overflows."""
    alone = Network(((0,),), 1, np.array([[[0.5, 0.5]]]), np.eye(2))
    found = average(chain(alone), aloha(alone, 1.0))
    assert found == pytest.approx((0.5, 0.0, 25 - 0.5))
    # Sends with chance p: full after a slot unless empty stays empty; balance f p / 2 = (1 - f) / 2.
    p = 0.3
    full = 1 / (1 + p)
    found = average(chain(alone), aloha(alone, p))
    assert found.throughput == pytest.approx(full * p)
    assert found.overflow == pytest.approx(full * (1 - p) / 2)


def test_slopes_agree_with_finite_differences():
    network = Network.pairs(1)
    one = chain(network)
    rule = np.random.default_rng(0).uniform(0.2, 0.8, (2, 2, 2, 2, 2))
    slope = slopes(one, rule)
    for place in [(0, 1, 1, 1, 1), (1, 0, 1, 0, 0), (1, 1, 1, 1, 0), (0, 0, 0, 1, 0)]:
        step = np.zeros_like(rule)
        step[place] = 1e-5
        difference = average(one, rule + step).throughput - average(one, rule - step).throughput
        assert slope[place] == pytest.approx(difference / 2e-5, abs=1e-8)


def test_ascent_ends_where_no_single_decision_helps():
    network = Network.pairs(1)
    one = chain(network)
    found = improve(one, np.full((2, 2, 2, 2, 2), 0.5))
    most = optimum(one).averages.throughput
    assert average(one, aloha(network, 0.5)).throughput < found.averages.throughput <= most + 1e-9
    for place in zip(*np.nonzero(np.ones_like(found.rule)), strict=True):
        other = found.rule.copy()
        other[place] = 1 - other[place]
        assert average(one, other).throughput <= found.averages.throughput + 1e-9


def test_ascent_leaves_a_saddle():
    """Two devices of which one alone is heard: no single chance matters at one half, two together do."""
    network = Network(((0,), (1,)), 1, np.tile([0.0, 1.0], (2, 1, 1)), reception([1.0], [0.0], senders=2))
    for chance in (0.4, 0.5, 0.6):
        found = improve(chain(network), aloha(network, chance))
        assert found.averages.throughput == pytest.approx(1.0)
        assert set(np.unique(found.rule)) <= {0.0, 1.0}


def test_what_cannot_be_solved_says_so(reference):
    with pytest.raises(InputError, match="at most 6000 states, got 10 devices"):
        chain(Network.pairs(5))
    with pytest.raises(InputError, match="rule: expected shape"):
        average(reference, np.zeros((4, 4, 2)))
    with pytest.raises(InputError, match="reception: expected rows of probabilities"):
        dataclasses.replace(NETWORK, reception=np.tril(np.ones((5, 5))))
    with pytest.raises(InputError, match="partition of the devices"):
        dataclasses.replace(NETWORK, clusters=((0, 1), (1, 2)))
    with pytest.raises(InputError, match="no more deliveries than senders"):
        dataclasses.replace(NETWORK, reception=np.full((5, 5), 0.2))
