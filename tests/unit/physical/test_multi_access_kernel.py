"""The transition of a network: its rules hold in every slot, and its frequencies are the tables' and the exact ones."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from dtprob.physical.multi_access import Network, PhysicalKernel, aloha, average, chain, reception, tdma

NETWORK = Network.reference()
UNEVEN = Network(
    ((3, 0, 4), (2,), (1,)),
    2,
    np.stack(
        [
            [np.roll([0.3, 0.1, 0.2, 0.05, 0.1, 0.05, 0.15, 0.05], shift) for shift in range(8)],
            [[0.7, 0.3] + [0] * 6, [0.2, 0.8] + [0] * 6] + [[0.0] * 8] * 6,
            [[0.4, 0.6] + [0] * 6] * 2 + [[0.0] * 8] * 6,
        ]
    ),
    reception([0.9], [0.5, 0.3], [0.2, 0.2, 0.2], senders=5),
)


def play(network, rule, slots, copies, seed=0):
    """States, actions and slots of independent copies, each leaf (slot, copy, ...)."""
    kernel = PhysicalKernel.of(network)
    parameters = jax.tree.map(jnp.asarray, network.parameters)
    table, device = jnp.asarray(rule), np.arange(network.devices)

    def one(state, key):
        act, go = jax.random.split(key)
        phase = state.slot % len(table)
        chance = table[phase, device, state.buffer, state.arrival, state.ack]
        action = (jax.random.uniform(act, chance.shape) < chance).astype(jnp.int32)
        after, slot = kernel.step(go, parameters, state, action)
        return after, (state, action, after, slot)

    def episode(key):
        return jax.lax.scan(one, kernel.initial(), jax.random.split(key, slots))[1]

    keys = jax.random.split(jax.random.key(seed), copies)
    played = jax.jit(jax.vmap(episode, out_axes=1))(keys)
    return jax.tree.map(np.asarray, played)


@pytest.fixture(scope="module")
def uneven():
    return play(UNEVEN, aloha(UNEVEN, 0.6), 200, 300)


def test_every_slot_obeys_the_rules(uneven):
    state, action, after, slot = uneven
    sends = action * (state.buffer > 0)
    assert np.all(slot.delivered <= sends)
    assert np.array_equal(after.ack, slot.delivered)
    full = state.buffer == UNEVEN.capacity
    assert np.array_equal(slot.overflow, full & (after.arrival == 1) & (after.ack == 0))
    assert np.array_equal(after.buffer, np.clip(state.buffer + after.arrival - after.ack, 0, 2))
    assert np.array_equal(slot.collision, sends.sum(-1) > slot.delivered.sum(-1))
    pay = np.where(slot.delivered == 1, 50, np.where(slot.overflow == 1, -50, -1)).sum(-1)
    assert np.array_equal(slot.reward, pay)
    assert after.buffer.min() == 0
    assert after.buffer.max() == 2


def fits(counts, law):
    """Whether counts agree with a law, but for one test in 10000; what cannot happen never does."""
    assert np.all(counts[law == 0] == 0)
    counts, law = counts[law > 0], law[law > 0]
    return len(law) == 1 or stats.chisquare(counts, counts.sum() * law).pvalue > 1e-4


def test_deliveries_follow_the_reception_table(uneven):
    state, action, _, slot = uneven
    number = (action * (state.buffer > 0)).sum(-1)
    for senders in range(6):
        here = slot.delivered.sum(-1)[number == senders]
        assert len(here) > 100
        assert fits(np.bincount(here, minlength=6), UNEVEN.reception[senders])


def test_which_senders_succeed_is_uniform(uneven):
    state, action, _, slot = uneven
    sends = action * (state.buffer > 0)
    for senders in ((0, 1, 4), (1, 2, 3)):
        pattern = np.isin(np.arange(5), senders)
        won = slot.delivered[np.all(sends == pattern, axis=-1) & (slot.delivered.sum(-1) == 2)][
            :, list(senders)
        ]
        pairs = np.bincount(won @ [4, 2, 1], minlength=8)
        assert fits(pairs, np.array([0, 0, 0, 1, 0, 1, 1, 0]) / 3)


def test_arrivals_follow_the_table_with_its_memory(uneven):
    state, _, after, _ = uneven
    weights = [(4, 2, 1), (1,), (1,)]
    for cluster, weight, rows in zip(UNEVEN.clusters, weights, UNEVEN.arrival, strict=True):
        last, new = (x[..., list(cluster)] @ np.array(weight) for x in (state.arrival, after.arrival))
        for previous in range(2 ** len(cluster)):
            assert fits(np.bincount(new[last == previous], minlength=8), rows[previous])


@pytest.mark.parametrize("name", ["tdma", "aloha"])
def test_simulation_agrees_with_the_exact_averages(name):
    rule = tdma(NETWORK, [[0, 1], [2, 3]]) if name == "tdma" else aloha(NETWORK, 0.54)
    exact = average(chain(NETWORK), rule)
    slot = play(NETWORK, rule, 450, 400)[3]
    late = jax.tree.map(lambda x: x[50:], slot)  # the empty start is forgotten
    for per_slot, value in (
        (late.delivered.sum(-1), exact.throughput),
        (late.overflow.mean(-1), exact.overflow),
        (late.reward, exact.reward),
    ):
        copies = per_slot.mean(axis=0)
        error = copies.std(ddof=1) / np.sqrt(len(copies))
        assert abs(copies.mean() - value) < 4 * error


def test_one_program_serves_all_parameters():
    kernel = PhysicalKernel.of(NETWORK)
    compiled = jax.jit(jax.vmap(kernel.step, in_axes=(0, 0, None, None)))
    tables = [
        NETWORK.parameters,
        dataclasses.replace(NETWORK, reception=np.eye(5)[:, [0, 1, 2, 3, 4]]).parameters,
    ]
    both = jax.tree.map(lambda *x: jnp.stack(x), *tables)
    full = kernel.initial()._replace(buffer=jnp.ones(4, jnp.int32))
    keys = jax.random.split(jax.random.key(0), 2)
    slot = compiled(keys, both, full, jnp.ones(4, jnp.int32))[1]
    assert np.asarray(slot.delivered).sum(-1).tolist() == [0, 4]
    assert np.asarray(slot.collision).tolist() == [True, False]
