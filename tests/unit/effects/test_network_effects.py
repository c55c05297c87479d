"""Effects on a network's traffic and channel: their contract, and what they do to laws that are known."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dtprob.effects import Meaning, catalogue
from dtprob.effects.network import FAMILIES
from dtprob.effects.network.laws import last_arrival, tilted
from dtprob.effects.rewriting import Rewriting
from dtprob.models.declaration import declare
from dtprob.models.execution import trace_model
from dtprob.models.multi_access import multi_access, records
from dtprob.testing import check_effect
from tests.small_network import ARRIVAL, CLUSTERS, simulate

TABLES = {
    "log_arrival": jnp.log(jnp.array([[[0.2, 0.4, 0.3, 0.1]]] * 2)),
    "log_reception": jnp.log(
        jnp.array(
            [
                [1, 0, 0, 0, 0],
                [0.1, 0.9, 0, 0, 0],
                [0.2, 0.5, 0.3, 0, 0],
                [0.6, 0.2, 0.1, 0.1, 0],
                [0.8, 0.1, 0.1, 0, 0],
            ]
        )
        + 1e-9
    ),
}
SHOWN = [
    "device_disconnected[device_1]", "arrival_rate_shift", "bursty_traffic[device_2]", "bursty_traffic[each_window]",
    "closed_loop_traffic[device_1]",
    "cross_cluster_traffic[0_with_2]", "cross_cluster_traffic[3_to_1]", "drift[device_0]", "drift[reception]",
    "drift[device_0_falling]",
    "reception_shift[2_senders]", "capture", "near_far[device_0]", "bursty_channel", "bursty_channel[each_window]",
    "interferer", "interferer[device_2]", "ack_loss[device_3]", "duty_cycle[device_1]",
]  # fmt: skip


@pytest.fixture(scope="module")
def data():
    return {**records(simulate(40, 0), clusters=CLUSTERS, window=10), "concentration": 1.0}


@pytest.fixture(scope="module")
def offered(data):
    return {effect.name: effect for effect in catalogue(declare(multi_access, data).sites, data)}


def test_every_family_has_instances_and_nothing_else_is_offered(offered):
    assert {effect.family for effect in offered.values()} == set(FAMILIES)
    assert {name.partition("[")[0] for name in SHOWN} == set(FAMILIES)


@pytest.mark.parametrize("name", SHOWN)
def test_effects_keep_their_contract(offered, data, name):
    check_effect(offered[name], multi_access, data)


def site_value(data, effect, site, **parameters):
    """Value of a site under the tables, with an effect of given parameters."""

    def extended(**arguments):
        chosen = () if effect is None else (effect,)
        with Rewriting(None, chosen, {e.name: parameters for e in chosen}, arguments):
            multi_access(**arguments)

    return trace_model(extended, data, jax.random.key(0), TABLES)[site]["value"]


def law(data, effect=None, site="arrival_logits", **parameters):
    """Probabilities at a site under the tables, with an effect of given parameters."""
    return np.asarray(jax.nn.softmax(site_value(data, effect, site, **parameters)))


def test_a_disconnected_device_generates_nothing_and_its_neighbour_as_before(offered, data):
    after = law(data, offered["device_disconnected[device_1]"], loss=jnp.array(50.0))
    np.testing.assert_allclose(after[0, 0, 0], [0.6, 0.0, 0.4, 0.0], atol=1e-9)
    np.testing.assert_allclose(after[0, 0, 1], [0.2, 0.4, 0.3, 0.1], atol=1e-9)
    half = law(data, offered["device_disconnected[device_0]"], loss=jnp.log(2.0))
    np.testing.assert_allclose(half[0, 0, 0], [0.35, 0.45, 0.15, 0.05], atol=1e-9)


def test_bursts_keep_the_load_of_a_device_and_its_neighbour_as_it_was(offered, data):
    """Where a device did what it does in a share p of all slots, it does so in a share p of the slots after."""
    before = law(data)[0, 0, 0]
    after = law(data, offered["bursty_traffic[device_1]"], persistence=jnp.log(4.0))
    last = (np.asarray(data["previous"])[..., 0] & 1) > 0
    given = {bool(value): after[last == value][0, 0] for value in (True, False)}
    with_ = before[[1, 3]].sum()
    mean = with_ * given[True] + (1 - with_) * given[False]
    np.testing.assert_allclose(mean[[1, 3]].sum(), with_, atol=1e-9)
    for one in given.values():
        np.testing.assert_allclose(one[[2, 3]].sum(), before[[2, 3]].sum(), atol=1e-9)
    np.testing.assert_allclose(given[True][[1, 3]].sum(), 0.25 * with_ + 0.75, atol=1e-9)
    np.testing.assert_allclose(given[False][[1, 3]].sum(), 0.25 * with_, atol=1e-9)


def test_a_source_in_a_closed_loop_generates_more_after_its_own_delivery_and_only_then(offered, data):
    before = law(data)[0, 0, 0]
    after = law(data, offered["closed_loop_traffic[device_1]"], log_odds=jnp.log(3.0))
    delivered = (np.asarray(data["acknowledged"])[..., 0] & 1) > 0
    assert 0 < delivered.sum() < delivered.size
    np.testing.assert_allclose(
        after[~delivered][:, 0], np.broadcast_to(before, (np.sum(~delivered), 4)), atol=1e-12
    )
    answered = after[delivered][:, 0]
    for has, has_not in ((1, 0), (3, 2)):  # without and with a packet of its neighbour
        np.testing.assert_allclose(answered[:, has] / answered[:, has_not], 3 * before[has] / before[has_not])
    np.testing.assert_allclose(answered[:, [2, 3]].sum(-1), before[[2, 3]].sum(), atol=1e-9)
    np.testing.assert_allclose(after[..., 1, :], law(data)[..., 1, :], atol=1e-12)  # the other cluster


@pytest.mark.study
def test_a_device_falls_silent_part_of_the_way():
    data = {**records(simulate(40, 0), clusters=CLUSTERS, window=4), "concentration": 1.0}
    offered = {effect.name: effect for effect in catalogue(declare(multi_access, data).sites, data)}
    effect = offered["device_disconnected[device_1]"]
    check_effect(effect, multi_access, data)
    before = law(data)
    after = law(data, effect, loss=jnp.array(50.0), onset=jnp.array(0.5))
    assert len(after) == 10
    np.testing.assert_allclose(after[0], before[0], atol=0.02)
    np.testing.assert_allclose(after[-1, 0, 0], [0.6, 0.0, 0.4, 0.0], atol=0.02)
    np.testing.assert_allclose(after[:, :, 1], before[:, :, 1], atol=1e-12)  # the other cluster


def test_the_disconnection_of_the_report(offered, data):
    assert np.array_equal(ARRIVAL, [0.2, 0.4, 0.4, 0.0])
    tables = {**TABLES, "log_arrival": jnp.log(jnp.broadcast_to(ARRIVAL, (2, 1, 4)) + 1e-12)}
    effect = offered["device_disconnected[device_1]"]
    value = trace_model(multi_access, data, jax.random.key(0), tables)["arrival_logits"]["value"]
    after = jax.nn.softmax(effect.rewrites["arrival_logits"](value, {"loss": jnp.array(50.0)}, data))
    np.testing.assert_allclose(after[0, 0, 0], [0.6, 0.0, 0.4, 0.0], atol=1e-9)


def test_one_device_s_odds_change_and_its_neighbours_go_on_as_before(offered, data):
    effect = offered["cross_cluster_traffic[0_with_3]"]
    before, after = law(data, None), law(data, effect, log_odds=jnp.array(1.4))
    grown = after.reshape(-1, *after.shape[-2:])[:, 1]
    first = before[0, 0, 1]
    with_, without = (grown[:, [has, has + 2]] for has in (1, 0))
    np.testing.assert_allclose(
        with_ + without, np.broadcast_to(first[[1, 3]] + first[[0, 2]], with_.shape), rtol=1e-6
    )
    factor = (with_ / without) / (first[[1, 3]] / first[[0, 2]])
    np.testing.assert_allclose(factor[:, 0], factor[:, 1], rtol=1e-5)
    np.testing.assert_allclose(np.unique(np.round(factor, 4)), np.round(np.exp([-0.7, 0.7]), 4), rtol=1e-3)
    others = after.reshape(-1, *after.shape[-2:])[:, 0]
    np.testing.assert_allclose(others, np.broadcast_to(before[0, 0, 0], others.shape), rtol=1e-6)


def test_a_packet_is_passed_on_to_the_other_cluster(offered, data):
    effect = offered["cross_cluster_traffic[3_to_0]"]
    before, after = law(data, None), law(data, effect, passed=jnp.log(4.0))
    grown = after.reshape(-1, *after.shape[-2:])
    first, last = before[0, 0, 0], np.asarray(last_arrival(data, data["clusters"], 3)).reshape(-1)
    assert set(np.unique(last)) == {0.0, 1.0}
    with_ = first[2:] + np.where(last[:, None] > 0, 0.75, 0.0) * first[:2]
    np.testing.assert_allclose(grown[:, 0, 2:], with_, atol=1e-9)
    np.testing.assert_allclose(grown[:, 1], np.broadcast_to(before[0, 0, 1], grown[:, 1].shape), rtol=1e-6)


@pytest.mark.parametrize("falling", [False, True])
def test_a_drift_begins_where_the_twin_has_learned(offered, data, falling):
    name = f"drift[device_0{'_falling' if falling else ''}]"
    before, after = (law(data, e, **p) for e, p in ((None, {}), (offered[name], {"amount": jnp.log(4.0)})))
    with_ = before[0, 0, 0, 2:].sum()
    share = 1 - 4.0 ** -np.linspace(0, 1, len(after))
    expected = with_ * (1 - share) if falling else with_ + share * (1 - with_)
    np.testing.assert_allclose(after[:, 0, 0, 2:].sum(axis=-1), expected, rtol=1e-6)
    kept = [after[:, 0, 0, [i, i + 2]].sum(axis=-1) for i in range(2)]  # what its neighbour does
    np.testing.assert_allclose(
        kept, [[before[0, 0, 0, [i, i + 2]].sum()] * len(after) for i in range(2)], rtol=1e-6
    )
    np.testing.assert_allclose(
        after[:, :, 1], np.broadcast_to(before[0, 0, 1], after[:, :, 1].shape), rtol=1e-6
    )


def test_a_busier_device_adds_packets_and_leaves_its_neighbour_alone(offered, data):
    after = law(data, offered["arrival_rate_shift[device_0]"], extra=jnp.log(2.0))
    np.testing.assert_allclose(after[0, 0, 0], [0.1, 0.2, 0.4, 0.3], atol=1e-9)
    np.testing.assert_allclose(after[0, 0, 1], [0.2, 0.4, 0.3, 0.1], atol=1e-9)


def test_what_cannot_happen_still_cannot_when_a_device_changes():
    logits = jnp.log(jnp.array([0.2, 0.4, 0.4, 0.0]))
    after, slope = jax.value_and_grad(lambda c: jax.nn.softmax(tilted(logits, 1, c))[1])(jnp.array(0.7))
    np.testing.assert_allclose(after, 0.6 * 2 * np.exp(0.7) / (1 + 2 * np.exp(0.7)), rtol=1e-6)
    assert np.isfinite(slope)
    assert slope > 0
    assert np.isneginf(tilted(logits, 1, jnp.array(0.7))[3])


def with_a_stranger(table):
    """Law of the known deliveries where a stranger sends too, for each number of known senders but the largest."""
    size, wider = len(table), np.zeros_like(table)
    for senders in range(1, size - 1):
        law = table[senders + 1]
        for delivered in range(senders + 2):
            strangers = delivered / (senders + 1)
            wider[senders, delivered] += law[delivered] * (1 - strangers)
            if delivered:
                wider[senders, delivered - 1] += law[delivered] * strangers
    wider[0, 0] = 1.0
    return wider


@pytest.mark.parametrize(("name", "parameter"), [("bursty_channel", "loss"), ("interferer", "activity")])
def test_bad_times_by_enumeration_of_all_of_them(offered, data, name, parameter):
    """The likelihood of six slots, summed over all 64 sequences of good and bad ones, is the product of the laws."""
    share, duration, length = 0.3, 4.0, 6
    amounts = {parameter: -jnp.log1p(-share), "log_duration": jnp.log(duration)}
    laws = law(data, offered[name], site="reception_logits", **amounts)
    senders, delivered = np.asarray(data["sending"]).sum(-1), np.asarray(data["deliveries"])
    table = np.exp(np.asarray(TABLES["log_reception"]))
    bad = np.eye(5)[np.zeros(5, int)] if name == "bursty_channel" else with_a_stranger(table)
    memory, told = np.exp(-1 / duration), 0
    for window in range(len(senders)):
        own, heard = senders[window, :length], delivered[window, :length]
        if own.max() + (name == "interferer") >= len(table):
            continue
        total = 0.0
        for states in itertools.product((0, 1), repeat=length):
            p = 1.0
            for t, state in enumerate(states):
                to_bad = share if t == 0 else share + memory * (states[t - 1] - share)
                p *= to_bad if state else 1 - to_bad
                p *= (bad if state else table)[own[t], heard[t]]
            total += p
        product = np.prod([laws[window, t, heard[t]] for t in range(length)])
        np.testing.assert_allclose(product, total, rtol=1e-4)
        told += 1
    assert told > 0


@pytest.mark.parametrize(
    ("name", "amount"), [("interferer", 1.0), ("ack_loss[device_1]", 0.5), ("capture", 2.0)]
)
def test_mixtures_of_receptions_stay_laws(offered, data, name, amount):
    effect = offered[name]
    parameter = effect.parameters[0].name
    before, after = law(data, site="reception_logits"), None
    logits = trace_model(multi_access, data, jax.random.key(0), TABLES)
    value = logits["reception_logits"]["value"]
    context = {**data, "log_reception": TABLES["log_reception"]}
    given = {**{p.name: jnp.asarray(p.null) for p in effect.parameters}, parameter: jnp.array(amount)}
    changed = effect.rewrites["reception_logits"](value, given, context)
    mass = np.asarray(jnp.exp(changed - jax.nn.logsumexp(value, axis=-1, keepdims=True)).sum(axis=-1))
    np.testing.assert_allclose(mass, 1.0, atol=1e-6)
    after = np.asarray(jax.nn.softmax(changed))
    senders = np.asarray(data["sending"]).sum(axis=-1)
    mean = (np.arange(5) * (after - before)).sum(axis=-1)
    sign = 1 if name == "capture" else -1
    assert np.all(sign * mean[senders >= 2] >= -1e-6)
    assert np.abs(mean[senders >= 1]).max() > 0.01


def test_receptions_shift_all_of_a_slot_at_once_or_one_by_one(offered, data):
    """Slots lost whole keep the law of what else is delivered; further deliveries keep the odds of one against none."""
    senders = np.asarray(data["sending"]).sum(-1)
    before, two = law(data, site="reception_logits"), senders == 2
    shift = offered["reception_shift[2_senders]"]
    lost = 0.25
    none, some = before[two][:, 0], 1 - before[two][:, 0]
    odds = np.log((1 - lost) * some / (none + lost * some) / (some / none))
    silenced = law(data, shift, "reception_logits", log_odds_of_any=float(odds[0]), log_odds_of_further=0.0)
    np.testing.assert_allclose(silenced[two][:, 1:], (1 - lost) * before[two][:, 1:], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(silenced[~two], before[~two], rtol=1e-6, atol=1e-12)
    further = law(data, shift, "reception_logits", log_odds_of_any=0.0, log_odds_of_further=0.7)
    ratio = (further[two][:, 2] / further[two][:, 1]) / (before[two][:, 2] / before[two][:, 1])
    np.testing.assert_allclose(ratio, np.exp(0.7), rtol=1e-5)
    odds = further[two][:, 1] / further[two][:, 0]
    np.testing.assert_allclose(odds, before[two][:, 1] / before[two][:, 0], rtol=1e-5)
    assert [p.name for p in offered["reception_shift[1_senders]"].parameters] == ["log_odds_of_any"]


def test_a_stranger_takes_its_share_of_the_deliveries(offered, data):
    senders = np.asarray(data["sending"]).sum(axis=-1)
    value = trace_model(multi_access, data, jax.random.key(0), TABLES)["reception_logits"]["value"]
    context = {**data, "log_reception": TABLES["log_reception"]}
    always = {"activity": jnp.array(60.0), "log_duration": jnp.array(1.6)}
    changed = offered["interferer"].rewrites["reception_logits"](value, always, context)
    alone = np.asarray(jax.nn.softmax(changed))[senders == 1]
    np.testing.assert_allclose(alone[0], [0.2 + 0.25, 0.25 + 0.3, 0, 0, 0], atol=1e-6)


def sets(devices, size):
    return [set(one) for one in itertools.combinations(devices, size)]


@pytest.mark.parametrize("name", ["ack_loss", "duty_cycle"])
def test_who_is_heard_where_one_is_not(offered, data, name):
    """Number and set of deliveries by enumeration, in every slot in which the device sends beside others."""
    device, share = 1, 0.6
    effect = offered[f"{name}[{device}]".replace("[", "[device_")]
    amount = {p.name: -jnp.log1p(-share) for p in effect.parameters}
    reception = law(data, effect, site="reception_logits", **amount)
    advantage = np.asarray(site_value(data, effect, "device_advantage", **amount))
    table = np.exp(np.asarray(TABLES["log_reception"]))
    sending, delivered = np.asarray(data["sending"], bool), np.asarray(data["deliveries"])
    seen = 0
    for episode, slot in np.argwhere(sending[..., device] & (sending.sum(-1) > 1)):
        senders = np.flatnonzero(sending[episode, slot]).tolist()
        others, chance = [i for i in senders if i != device], {}
        for count in range(len(senders) + 1):
            for chosen in sets(senders, count):  # as it would have been
                p = table[len(senders), count] / math.comb(len(senders), count)
                chance[frozenset(chosen)] = chance.get(frozenset(chosen), 0.0) + (1 - share) * p
                if name == "ack_loss":
                    heard = frozenset(chosen - {device})
                    chance[heard] = chance.get(heard, 0.0) + share * p
        if name == "duty_cycle":
            for count in range(len(others) + 1):
                for chosen in sets(others, count):
                    p = table[len(others), count] / math.comb(len(others), count)
                    chance[frozenset(chosen)] += share * p
        number = [sum(p for s, p in chance.items() if len(s) == k) for k in range(len(senders) + 1)]
        np.testing.assert_allclose(reception[episode, slot, : len(senders) + 1], number, atol=1e-6)
        count = int(delivered[episode, slot])
        if 0 < count < len(senders):
            odds = np.exp(advantage[episode, slot])
            weights = {s: np.prod([odds[i] for i in s]) for s in chance if len(s) == count}
            exact = sum(p for s, p in chance.items() if len(s) == count and device in s) / number[count]
            own = sum(w for s, w in weights.items() if device in s) / sum(weights.values())
            np.testing.assert_allclose(own, exact, atol=1e-6)
            seen += 1
    assert seen > 0


def test_every_size_says_what_it_means(offered):
    """A share of slots is not told as the number whose exponential it is."""
    effects = [effect for effect in offered.values() if effect.family in FAMILIES]
    assert {effect.family for effect in effects} == set(FAMILIES)
    for parameter in (p for effect in effects for p in effect.parameters):
        assert parameter.meaning is not None
        assert (parameter.meaning.told_as == "factor") == (
            parameter.name.startswith("log_") or parameter.name == "advantage"
        )
    assert offered["duty_cycle[device_1]"].parameters[0].meaning == Meaning(
        "slots in which its radio is off", "share"
    )
