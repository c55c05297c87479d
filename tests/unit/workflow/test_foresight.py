"""What is foreseen of a policy: on how much of it nobody has seen, and what is done where less is delivered."""

import dataclasses

import jax
import numpy as np
import pytest

from dtprob.models.multi_access import priors
from dtprob.workflow.loop import Twin, advance, begin, connect, load_twin_case
from dtprob.workflow.loop.foresight import HORIZON, RATE, foresee, seldom_seen, shortfall

CASE = """
[model]
name = "multi_access"
[model.options]
clusters = [[0, 1]]
[physical]
environment = "multi_access"
[physical.options]
pairs = 1
[loop]
slots = 1000
"""
SENDS = np.ones((1, 2, 2, 2, 2))


@pytest.fixture(name="case", scope="module")
def _case(tmp_path_factory):
    path = tmp_path_factory.mktemp("foresight") / "twin.toml"
    path.write_text(CASE)
    return load_twin_case(path)


@pytest.mark.parametrize(("times", "share"), [(3, (HORIZON - 1) / HORIZON), (1000, 0.0)])
def test_slots_on_rows_seldom_seen_are_counted(case, times, share):
    """Both devices get a packet in every slot and always send, so that all slots but the first have two senders."""
    fresh = priors(case.kernel.clusters, case.concentration)
    arrival, reception = fresh["log_arrival"].copy(), fresh["log_reception"].copy()
    arrival[0, 0, 3] += 1e12
    reception[2, 0] += times
    state = begin(case)._replace(prior={"log_arrival": arrival, "log_reception": reception})
    assert seldom_seen(jax.random.key(0), case, state, SENDS) == pytest.approx(share, abs=1e-6)
    found = foresee(jax.random.key(0), case, state, SENDS)
    mean = (0.5 * 1 + 0.5 * 2) / (1.5 + times)  # deliveries of a slot with two senders
    error = found.values.mean(axis=1).std() / np.sqrt(len(found.values))
    assert abs(found.mean - mean * (HORIZON - 1) / HORIZON) < 5 * error


def after(case, delivered, foreseen, slots=1000):
    """A state in which one device was delivered as drawn."""
    ack = np.stack([delivered[:slots], np.zeros(slots, int)], axis=1)
    rows = {**begin(case).rows, "ack": ack, "slot": np.arange(slots)}
    return begin(case)._replace(rows=rows, foreseen=foreseen)


def test_a_shortfall_is_called_where_a_stretch_is_below_what_was_foreseen(case):
    random = np.random.default_rng(0)
    foreseen = random.binomial(HORIZON, random.beta(20, 20, 1600)) / HORIZON
    good, bad = (random.random(1000) < chance for chance in (0.5, 0.1))
    assert shortfall(after(case, good, foreseen)) is None
    found = shortfall(after(case, np.concatenate([good[:400], bad]), foreseen))
    assert found["shortfall"]["slots"] == [400, 600]
    assert shortfall(after(case, bad, foreseen, slots=HORIZON - 1)) is None


def test_a_network_of_the_learned_law_seldom_falls_short(case):
    """Chances and slots from the law that was foreseen, which all stretches of a network share; 3 standard errors."""
    random, count = np.random.default_rng(1), 600
    foreseen = random.binomial(HORIZON, random.beta(4, 4, 1600)) / HORIZON
    delivered = random.random((count, 1000)) < random.beta(4, 4, count)[:, None]
    called = np.mean([shortfall(after(case, row, foreseen)) is not None for row in delivered])
    assert called < RATE + 3 * np.sqrt(RATE * (1 - RATE) / count)
    assert called > 0


@pytest.mark.parametrize("relearn", [True, False])
def test_a_policy_that_delivers_less_than_foreseen_is_learned_again(case, relearn):
    """A silent one of which much was foreseen: all slots since the last change count when it is learned anew."""
    case = dataclasses.replace(case, loop=dataclasses.replace(case.loop, relearn=relearn, slots=300))
    state = begin(case)._replace(phase="monitor", watched=0, foreseen=np.full(1600, 0.9))
    twin = Twin(case, connect(case), lambda _: None)
    while state.phase == "monitor":
        state = advance(twin, state)
    (entry,) = state.entries
    assert entry["shortfall"]["slots"] == [0, HORIZON]
    assert entry["why"].startswith("delivers less than foreseen: 0.000 packets per slot from slot 0 to 200")
    assert not entry["alarm"]
    assert (state.phase, state.round, state.slots) == (("learn", 2, 200) if relearn else ("done", 1, 300))
    assert (state.since, state.watched) == (0, 0)
