"""The multi-access system as a model and as a kernel: laws, counts, and agreement of the two."""

from dataclasses import fields

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers
from numpyro.infer.util import compute_log_probs

from dtprob.data import NetworkLog
from dtprob.data.network import from_columns
from dtprob.errors import InputError
from dtprob.models.declaration import declare
from dtprob.models.multi_access import Clusters, kernel, multi_access, records, window_counts
from dtprob.models.multi_access.model import success_log_odds
from dtprob.models.multi_access.transition import Noise, State
from dtprob.testing import check_model
from tests.small_network import ARRIVAL, CLUSTERS, RECEPTION, simulate

TABLES = {
    "log_arrival": jnp.log(jnp.broadcast_to(ARRIVAL, (2, 1, 4))),
    "log_reception": jnp.log(jnp.array([RECEPTION[n] + [0.0] * (5 - len(RECEPTION[n])) for n in range(5)])),
}


@pytest.fixture(scope="module")
def log():
    return simulate(60, 0)


@pytest.mark.parametrize("traffic", [pytest.param("memoryless", marks=pytest.mark.study), "markov"])
def test_model_keeps_its_contract(log, traffic):
    check_model(multi_access, {**records(log, clusters=CLUSTERS), "traffic": traffic, "concentration": 1.0})


def test_sites_and_axes(log):
    sites = declare(multi_access, records(log, clusters=CLUSTERS, window=15)).sites
    assert sites["log_arrival"].shape == (2, 1, 4)
    assert sites["log_reception"].shape == (5, 5)
    assert sites["arrivals"].axes == ("episode", "slot", "cluster")
    assert sites["arrivals"].shape == (4, 15, 2)
    assert set(sites["deliveries"].plates) == {"episode", "slot"}


def test_windows_keep_every_slot_and_its_past(log):
    arguments = records(log, clusters=CLUSTERS, window=7)
    valid = arguments["valid"]
    assert valid.sum() == len(log.slot)
    assert np.array_equal(arguments["successes"][valid], log.ack)
    joint = 2 * log.arrival[:, ::2] + log.arrival[:, 1::2]
    assert np.array_equal(arguments["arrivals"][valid], joint)
    assert np.array_equal(arguments["previous"][valid][1:], joint[:-1])
    delivered = 2 * log.ack[:, ::2] + log.ack[:, 1::2]
    assert np.array_equal(arguments["acknowledged"][valid][1:], delivered[:-1])
    assert not arguments["acknowledged"][0, 0].any()


def test_counts(log):
    counts = window_counts(records(log, clusters=CLUSTERS, window=7), memory=True)
    assert counts["log_arrival"].shape == (9, 2, 4, 4)
    total = counts["log_arrival"].sum(axis=(0, 2))
    joint = 2 * log.arrival[:, ::2] + log.arrival[:, 1::2]
    assert np.array_equal(total, [np.bincount(joint[:, c], minlength=4) for c in range(2)])
    senders = ((log.action > 0) & (log.buffer > 0)).sum(axis=1)
    assert np.array_equal(counts["log_reception"].sum(axis=(0, 2)), np.bincount(senders, minlength=5))


def test_after_a_gap_arrivals_do_not_count():
    """What came before the first slot after a gap is not known; by enumeration of the pairs of slots in the log."""
    random = np.random.default_rng(0)
    arrival = np.zeros(400, int)
    for slot in range(1, 400):
        arrival[slot] = random.random() < (0.8 if arrival[slot - 1] else 0.1)
    kept = np.flatnonzero(random.random(400) < 0.7)
    buffer = np.concatenate([[0], np.maximum.accumulate(arrival)[:-1]])  # of a device that never sends
    columns = {"slot": kept, "arrival_0": arrival[kept], "buffer_0": buffer[kept]}
    columns |= {name: np.zeros_like(kept) for name in ("episode", "action_0", "ack_0")}
    arguments = records(from_columns(columns, allow_gaps=True), clusters=((0,),), window=10)
    expected = np.zeros((2, 2))
    for slot in kept:
        if slot == 0 or slot - 1 in kept:
            expected[arrival[slot - 1] if slot else 0, arrival[slot]] += 1
    counts = {name: value.sum(axis=0) for name, value in window_counts(arguments, memory=True).items()}
    assert np.array_equal(counts["log_arrival"][0], expected)
    assert counts["log_reception"].sum() == len(kept)
    tables = {
        "log_arrival": jnp.log(jnp.array([[[0.7, 0.3], [0.4, 0.6]]])),
        "log_reception": jnp.zeros((2, 2)),
    }
    given = {**arguments, "traffic": "markov"}
    fixed = handlers.substitute(handlers.seed(multi_access, jax.random.key(0)), data=tables)
    found = compute_log_probs(fixed, (), given, {})[0]["arrivals"]
    np.testing.assert_allclose(found, np.sum(expected * np.asarray(tables["log_arrival"][0])), rtol=1e-6)


def test_a_log_from_the_first_slot_on_is_known_throughout(log):
    arguments = records(log, clusters=CLUSTERS, window=7)
    assert np.array_equal(arguments["preceded"], arguments["valid"])
    later = NetworkLog(**{field.name: getattr(log, field.name)[20:] for field in fields(log)})
    cut = records(later, clusters=CLUSTERS, window=7)
    assert np.argwhere(cut["preceded"] != cut["valid"]).tolist() == [[0, 0]]


def test_kernel_follows_the_laws():
    system = kernel(CLUSTERS)
    state = State(jnp.array([1, 1, 0, 1]), *[jnp.zeros(4, int)] * 2, jnp.zeros((), int))
    action = jnp.array([1, 1, 1, 0])
    step = jax.jit(jax.vmap(lambda key: system.step(key, TABLES, state, action)))
    after, slot = step(jax.random.split(jax.random.key(0), 20_000))
    delivered = np.asarray(slot.delivered)
    assert not delivered[:, 2:].any()
    frequencies = np.bincount(delivered.sum(axis=1), minlength=3) / len(delivered)
    np.testing.assert_allclose(frequencies, [0, 0.8, 0.2], atol=4.5 * np.sqrt(0.16 / len(delivered)))
    alone = delivered[delivered.sum(axis=1) == 1]
    assert abs(alone[:, 0].mean() - 0.5) < 4.5 * 0.5 / np.sqrt(len(alone))
    arrival = np.asarray(after.arrival)
    joint = np.bincount(2 * arrival[:, 0] + arrival[:, 1], minlength=4) / len(arrival)
    np.testing.assert_allclose(joint, ARRIVAL, atol=4.5 * np.sqrt(0.24 / len(arrival)))
    full = np.asarray(state.buffer) + arrival - delivered
    assert np.array_equal(np.asarray(after.buffer), np.clip(full, 0, 1))
    reward = np.where(delivered, 50.0, np.where(full > 1, -50.0, -1.0)).sum(axis=1)
    np.testing.assert_allclose(slot.reward, reward)


def test_extreme_luck_never_gives_what_cannot_happen():
    system = kernel(CLUSTERS)
    state = system.initial()._replace(buffer=jnp.ones(4, int))
    for value in (0.0, np.nextafter(1.0, 0.0)):
        noise = Noise(jnp.full(2, value), jnp.asarray(value), jnp.arange(4.0) / 4)
        after, slot = system.respond(noise, TABLES, state, jnp.array([1, 1, 0, 0]))
        assert 1 <= int(slot.delivered.sum()) <= 2
        assert not np.any(np.asarray(after.arrival).reshape(2, 2).all(axis=1))


def test_who_is_delivered_is_the_conditional_bernoulli_law():
    advantage = np.array([0.7, -0.3, 0.2, 1.1])
    sets = [(a, b) for a in range(4) for b in range(a)]
    weight = np.array([np.exp(advantage[list(pair)].sum()) for pair in sets])
    total = 0.0
    for pair, expected in zip(sets, weight / weight.sum(), strict=True):
        success = np.zeros((1, 1, 4), int)
        success[0, 0, list(pair)] = 1
        is_open, log_odds = success_log_odds(
            jnp.asarray(advantage)[None, None],
            jnp.ones((1, 1, 4), bool),
            jnp.array([[2]]),
            jnp.asarray(success),
        )
        chance = np.where(success, 1, -1) * np.asarray(log_odds)
        probability = np.prod(np.where(is_open, 1 / (1 + np.exp(-chance)), 1.0))
        np.testing.assert_allclose(probability, expected, rtol=1e-9)
        total += probability
    assert total == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("members", "message"),
    [
        (((0, 1), (1, 2)), "clusters: expected each device once"),
        (((0, 2),), "clusters: expected each device once"),
        ((0, 1), "clusters: expected lists of devices' numbers, got \\[0, 1\\]"),
        (((0.5, 1),), "clusters: expected lists of devices' numbers"),
        (((False, True),), "clusters: expected lists of devices' numbers"),
        ((tuple(range(13)),), "clusters: expected at most 12 devices each, got 13"),
    ],
)
def test_clusters_that_are_no_partition_are_refused(members, message):
    with pytest.raises(InputError, match=message):
        Clusters(members)


def test_what_is_no_capacity_or_concentration_is_refused(log):
    with pytest.raises(InputError, match="clusters: expected lists of devices' numbers"):
        kernel((0, 1))
    with pytest.raises(TypeError, match="integer"):
        kernel(((0,), (1,)), 1.5)
    with pytest.raises(InputError, match="clusters: expected lists of devices' numbers"):
        records(log, clusters=[0, 1, 2, 3])
    with pytest.raises(
        InputError, match="concentration of a Dirichlet law: expected a finite number above 0"
    ):
        declare(multi_access, {**records(log, clusters=CLUSTERS), "concentration": 0.0})


def test_a_log_that_does_not_fit_is_refused(log):
    with pytest.raises(InputError, match="expected the 4 devices of the log, got 2 devices"):
        records(log, clusters=((0, 1),))
    with pytest.raises(InputError, match="expected no loss below 2 packets, the capacity"):
        records(log, clusters=CLUSTERS, capacity=2)
