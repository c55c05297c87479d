"""Policies see only what is theirs, remember only their episode, and survive export."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.control import (
    IPPO,
    Budget,
    FramePolicy,
    HistoryPolicy,
    Stateless,
    TablePolicy,
    aloha,
    evaluate,
    tabulate,
    tdma,
    train,
)
from dtprob.control.device import Seen, step
from dtprob.control.environment import Observation
from dtprob.control.export import load, save
from dtprob.control.policy import unroll
from dtprob.control.rollout import begin, play
from dtprob.errors import InputError
from dtprob.inference import PointMass
from dtprob.physical.multi_access import PhysicalKernel, average, chain
from dtprob.twin.predict import predict
from dtprob.twin.rollout import random_access, throughput
from tests.unit.control.networks import NETWORK, PAIR, world

KEY = jax.random.key(0)
NETWORK_KERNEL = PhysicalKernel.of(NETWORK)


def observations(slots, devices=4, seed=0):
    draw = np.random.default_rng(seed).integers(0, 2, (4, slots, devices))
    return Observation(*(jnp.asarray(part) for part in draw), slot=jnp.arange(slots))


@pytest.mark.parametrize("kind", [FramePolicy, HistoryPolicy])
def test_no_device_sees_another(kind):
    policy, seen = kind(KEY, 4), observations(12)
    start = jnp.zeros(12, bool)
    logit = unroll(policy, policy.initial(), seen, start)[1]
    other = seen._replace(
        **{name: getattr(seen, name).at[:, 2].apply(lambda x: 1 - x) for name in ("buffer", "arrival", "ack")}
    )
    changed = unroll(policy, policy.initial(), other, start)[1] != logit
    assert changed[:, 2].all()
    assert not changed[:, [0, 1, 3]].any()


def test_a_history_begins_with_its_episode():
    policy, seen = HistoryPolicy(KEY, 4), observations(12)
    logit = unroll(policy, policy.initial(), seen, jnp.arange(12) == 7)[1]
    later = jax.tree.map(lambda leaf: leaf[7:], seen)
    fresh = unroll(policy, policy.initial(), later, jnp.zeros(5, bool))[1]
    np.testing.assert_allclose(logit[7:], fresh, rtol=1e-6)
    kept = unroll(policy, policy.initial(), seen, jnp.zeros(12, bool))[1]
    assert np.all(np.abs(kept[7:] - fresh) > 1e-6)


@pytest.mark.parametrize("kind", [FramePolicy, HistoryPolicy])
def test_log_odds_of_a_replay_are_those_of_the_play(kind):
    policy, environment = kind(KEY, 2), world(PAIR, horizon=7)
    now = begin(KEY, environment, policy, 3)
    played = play(KEY, environment, policy, now, 20)[1]
    logit = jax.vmap(unroll, (None, 0, 1, 1), (0, 1))(policy, now.memory, played.observation, played.start)[1]
    np.testing.assert_allclose(logit, played.logit, rtol=1e-6, atol=1e-9)
    assert played.start[:, 0].tolist() == [slot % 7 == 0 for slot in range(20)]


def test_fixed_rules_deliver_what_the_exact_averages_say():
    environment = world(NETWORK, horizon=10**6)
    for policy in (tdma(4, 1, [[0, 1], [2, 3]]), aloha(4, 1, 0.25)):
        exact = average(chain(NETWORK), np.asarray(policy.probability))
        got = evaluate(KEY, environment, policy, 500, 300)
        for value, law in zip(got, exact, strict=True):
            # Slots from the empty start on: 20 of 500 may be off by the whole value, 4 standard errors besides.
            error = 4 * np.std(value) / np.sqrt(len(value)) + 0.01 * abs(law)
            assert abs(np.mean(value) - law) < error


def test_a_frame_may_have_silent_slots_and_no_strangers():
    table = np.asarray(tdma(3, 1, [[0, 2], []]).probability)
    assert table[0, :, 1, 0, 0].tolist() == [1.0, 0.0, 1.0]
    assert not table[1].any()
    with pytest.raises(InputError, match=r"devices from 0 to 2, got \[3\] in slot 1"):
        tdma(3, 1, [[0], [3]])


def test_a_table_sends_as_the_network_it_was_made_from(tmp_path):
    policy = FramePolicy(KEY, 4)
    save(tabulate(policy), tmp_path / "policy.json")
    table = load(tmp_path / "policy.json")
    seen = observations(16)
    start = jnp.zeros(16, bool)
    ours = unroll(policy, policy.initial(), seen, start)[1]
    theirs = unroll(table, table.initial(), seen, start)[1]
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)
    assert np.array_equal(table.probability, tabulate(policy).probability)


@pytest.mark.parametrize(
    "content",
    [
        "nothing",
        "{}",
        json.dumps({"format": "dtprob policy table 1", "probability": [[[[[2.0, 0], [0, 0]]]]]}),
    ],
)
def test_what_is_no_table_is_refused(tmp_path, content):
    (tmp_path / "policy.json").write_text(content)
    with pytest.raises(InputError, match="Write it with save"):
        load(tmp_path / "policy.json")
    with pytest.raises(InputError, match="FileNotFoundError"):
        load(tmp_path / "missing.json")


def test_a_recurrent_policy_runs_on_a_device_as_it_was_trained(tmp_path):
    """Loaded again it is the same; a device's own step in NumPy gives the same chances over a history."""
    policy, seen = HistoryPolicy(KEY, 4), observations(16)
    save(policy, tmp_path / "policy.npz")
    again = load(tmp_path / "policy.npz")
    assert all(map(np.array_equal, jax.tree.leaves(policy), jax.tree.leaves(again)))
    start = jnp.zeros(16, bool)
    logit = np.asarray(unroll(policy, policy.initial(), seen, start)[1], float)
    with np.load(tmp_path / "policy.npz", allow_pickle=False) as stored:
        weights = {name: stored[name] for name in stored.files if name != "format"}
    for own in range(4):
        memory = np.zeros(16)
        for slot in range(16):
            now = Seen(*(int(part[slot, own]) for part in seen[:4]), int(seen.slot[slot]))
            memory, chance = step(weights, own, memory, now)
            assert chance == pytest.approx(1 / (1 + np.exp(-logit[slot, own])), rel=1e-5)


def test_what_is_no_recurrent_policy_is_refused(tmp_path):
    for content in ("nothing", "", "PK\x03\x04 cut off"):
        (tmp_path / "policy.npz").write_text(content)
        with pytest.raises(InputError, match="a policy"):
            load(tmp_path / "policy.npz")
    with pytest.raises(InputError, match=r"the suffix \.npz"):
        save(HistoryPolicy(KEY, 4), tmp_path / "policy.json")
    save(HistoryPolicy(KEY, 4), tmp_path / "policy.npz")
    with np.load(tmp_path / "policy.npz", allow_pickle=False) as stored:
        np.savez(tmp_path / "policy.npz", **{**stored, "cell_bias": np.zeros(3)})
    with pytest.raises(InputError, match="cell_bias"):
        load(tmp_path / "policy.npz")


def test_policies_meet_the_same_arrivals():
    environment = world(NETWORK, horizon=10**6)
    seen = []
    for chance in (0.1, 0.9):
        policy = aloha(4, 1, chance)
        now = begin(KEY, environment, policy, 2)
        seen.append(play(KEY, environment, policy, now, 30)[1].observation.arrival)
    assert np.array_equal(*seen)
    assert isinstance(policy, TablePolicy)


@pytest.mark.parametrize("probability", [54.0, -0.1])
def test_a_chance_is_between_zero_and_one(probability):
    with pytest.raises(InputError, match="from 0 to 1"):
        aloha(4, 1, probability)
    with pytest.raises(InputError, match="from 0 to 1"):
        random_access(4, probability)


def test_chances_may_be_swept():
    swept = jax.vmap(lambda p: aloha(4, 1, p).probability.mean())(jnp.array([0.1, 0.5]))
    np.testing.assert_allclose(swept, [0.1, 0.5])


def test_what_is_of_another_size_is_refused_and_not_clamped():
    network = world(NETWORK)
    devices, capacity = NETWORK_KERNEL.devices, NETWORK_KERNEL.capacity
    for policy, what in (
        (FramePolicy(KEY, devices, capacity=capacity - 1), "capacity of FramePolicy"),
        (aloha(devices, capacity - 1, 0.5), "capacity of TablePolicy"),
        (HistoryPolicy(KEY, devices + 1), "devices of HistoryPolicy"),
    ):
        with pytest.raises(InputError, match=what):
            evaluate(KEY, network, policy, 10, 2)
    assert evaluate(KEY, network, aloha(devices, capacity + 2, 0.5), 10, 2).reward.shape == (2,)
    policy = FramePolicy(KEY, devices, capacity=capacity)
    with pytest.raises(InputError, match="capacity of IPPO"):
        train(KEY, IPPO(capacity=capacity - 1), policy, network, Budget(8, environments=2, length=4))


def test_a_policy_without_memory_foresees_what_it_reaches():
    policy = aloha(4, 1, 0.25)
    given = {"metric": throughput, "horizon": 2000, "draws": 1, "episodes": 20}
    with pytest.raises(InputError, match="Stateless"):
        predict(KEY, NETWORK_KERNEL, PointMass(NETWORK.parameters), policy=policy, **given)
    found = predict(KEY, NETWORK_KERNEL, PointMass(NETWORK.parameters), policy=Stateless(policy), **given)
    played = evaluate(KEY, world(NETWORK, horizon=2000), policy, 2000, 20).throughput
    assert found.mean == pytest.approx(float(played.mean()), abs=0.02)
    with pytest.raises(InputError, match="one without memory"):
        Stateless(HistoryPolicy(KEY, 4))
