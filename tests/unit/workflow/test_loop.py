"""The loop of a network's twin: what it sees of a change, what it does then, and that it goes on where it stopped."""

import dataclasses
import itertools
import json
import math

import jax
import numpy as np
import pytest

from dtprob.cli import main
from dtprob.errors import InputError
from dtprob.models.dirichlet import log_marginal
from dtprob.physical.multi_access import Network, average, chain, tdma
from dtprob.physical.multi_access.changing import changing_network
from dtprob.workflow.loop import Twin, advance, begin, connect, finished, history, load, load_twin_case, save
from dtprob.workflow.loop.knowledge import forget, known, row_counts, watch
from dtprob.workflow.loop.physical import LoggedNetwork, PlayedNetwork

CHANGE = 500
CASE = f"""
[model]
name = "multi_access"
[model.options]
clusters = [[0, 1], [2, 3]]
[physical]
environment = "multi_access"
[physical.options]
disconnect = [[{CHANGE}, 1]]
horizon = 350
[loop]
slots = 1000
training = 15000
caution = 6.0
diagnose = 0
"""
PAIRS = ((0, 1), (2, 3))
TURNS = tdma(Network.reference(), PAIRS)


@pytest.fixture(name="case", scope="module")
def _case(tmp_path_factory):
    path = tmp_path_factory.mktemp("loop") / "twin.toml"
    path.write_text(CASE)
    return load_twin_case(path)


def twin(case):
    return Twin(case, connect(case), lambda _: None)


def test_the_marginal_is_a_product_of_predictions():
    prior, outcomes = np.array([0.3, 0.0, 1.2, 0.5]), [2, 2, 0, 3, 2]
    counts, expected = np.zeros(4), 0.0
    for outcome in outcomes:
        expected += math.log((prior + counts)[outcome] / (prior + counts).sum())
        counts[outcome] += 1
    assert log_marginal(prior, counts) == pytest.approx(expected, rel=1e-12)
    assert log_marginal(prior, np.array([[0.0, 1, 0, 0], [0, 0, 0, 0]])).tolist() == [-np.inf, 0.0]
    every = [np.bincount(s, minlength=4) for s in itertools.product((0, 2, 3), repeat=3)]
    assert np.exp(log_marginal(prior, np.array(every, float))).sum() == pytest.approx(1.0, rel=1e-12)


def test_counts_of_rows_are_those_of_what_happened(case):
    rows = connect(case).play(TURNS, 400, np.random.default_rng(0))
    counts = row_counts(case, rows)
    sends = (rows["action"] * (rows["buffer"] > 0)).sum(axis=1)
    assert np.array_equal(counts["log_reception"].sum(axis=2).argmax(axis=1), sends)
    assert np.array_equal(counts["log_reception"].sum(axis=1).argmax(axis=1), rows["ack"].sum(axis=1))
    second = rows["arrival"][:, 2:] @ [2, 1]
    assert np.array_equal(counts["log_arrival"][:, 1, 0].argmax(axis=1), second)
    assert rows["slot"].max() == 349  # the episode's end; the next row begins another
    assert rows["episode"].tolist() == [0] * 350 + [1] * 50


def watched(case, seed, handed, slots):
    """A state in which time slots are watched, after as many slots that were learned from."""
    own = dataclasses.replace(case, seed=dataclasses.replace(case.seed, value=seed))
    rows = connect(own).play(TURNS, slots, np.random.default_rng(seed))
    return own, begin(own)._replace(rows=rows, handed=handed, watched=handed)


def test_a_change_is_seen_placed_and_its_factor_named(case):
    for seed in range(6):
        own, state = watched(case, seed, 200, 600)
        seen = watch(own, state)
        assert seen.alarm is not None
        assert CHANGE <= 200 + (seen.alarm + 1) * 10 <= CHANGE + 80
        assert abs(seen.changed - CHANGE) <= 20
        assert max(seen.blame, key=seen.blame.get) == "arrivals[0]"


def test_windows_that_were_judged_need_not_be_judged_again(case):
    own, state = watched(case, 0, 200, 600)
    whole, part = watch(own, state), state._replace(rows={n: c[:430] for n, c in state.rows.items()})
    before = watch(own, part).detector
    assert len(before) == 23
    again = watch(own, state._replace(detector=before))
    np.testing.assert_allclose(again.detector, whole.detector, rtol=1e-9)
    assert (again.alarm, again.changed) == (whole.alarm, whole.changed)


def test_false_alarms_are_as_rare_as_said(case):
    """Mean windows to a false alarm 1000, so at most 30/1000 of logs of 30 windows have one; 3 of 20 is p < .02 then."""
    alarms = 0
    for seed in range(20):
        own, state = watched(case, 100 + seed, 190, 490)
        alarms += watch(own, state).alarm is not None
    assert alarms < 3


def test_only_what_changed_is_forgotten(case):
    own, state = watched(case, 0, 200, 600)
    state = state._replace(changed=CHANGE)
    tables, gone = forget(own, state, {"arrivals[0]": 0.97, "arrivals[1]": 0.01, "reception": 0.02})
    before = known(own, state, CHANGE).concentration
    assert gone == ("arrivals[0]",)
    assert np.all(tables["log_arrival"][0] == case.concentration)
    assert np.array_equal(tables["log_arrival"][1], before["log_arrival"][1])
    assert np.array_equal(tables["log_reception"], before["log_reception"])
    after = known(own, state._replace(prior=tables, since=CHANGE)).concentration
    assert after["log_arrival"][0].sum() == pytest.approx(100 + 4 * case.concentration)
    assert after["log_arrival"][1].sum() == pytest.approx(600 + 4 * case.concentration)


@pytest.fixture(name="runs", scope="module")
def _runs(case, tmp_path_factory):
    """The whole loop; the same, stopped and resumed after every few steps; and one that learns once."""
    file = tmp_path_factory.mktemp("state") / "state.npz"
    with jax.enable_x64(False):
        whole, part, first = begin(case), begin(case), None
        running = twin(case)
        while not finished(whole):
            whole = advance(running, whole)
            if whole.phase == "monitor" and first is None:
                first = whole
        for step in itertools.count():
            if step % 3 == 0:
                save(part, case, file)
                part = load(case, file)
                resumed = twin(case)
                resumed.physical.go_on(part.rows)
            part = advance(resumed, part)
            if finished(part):
                break
        once = dataclasses.replace(case, loop=dataclasses.replace(case.loop, relearn=False))
        still = twin(once)
        still.physical.go_on(first.rows)
        while not finished(first):
            first = advance(still, first)
    return whole, part, first


@pytest.mark.study
def test_a_resumed_loop_is_the_same_to_the_last_bit(case, runs):
    whole, part, _ = runs
    assert json.dumps(history(case, whole)) == json.dumps(history(case, part))
    for name, column in whole.rows.items():
        assert np.array_equal(column, part.rows[name])
    assert np.array_equal(whole.policy, part.policy)


@pytest.mark.study
def test_the_history_says_what_was_done_and_why(case, runs):
    entries = history(case, runs[0])["entries"]
    once = ["collect", "learn", "control", "hand_over", "monitor"]
    assert [each["phase"] for each in entries] == [*once, *once[1:], "diagnose", *once]
    first, short, second, alarm, diagnosis = (entries[number] for number in (3, 4, 7, 8, 9))
    assert first["handed_over"]
    assert first["seldom_seen"]["share_of_foreseen_slots"] > second["seldom_seen"]["share_of_foreseen_slots"]
    assert short["shortfall"]["slots"][1] == short["slots"][1] < CHANGE
    assert short["throughput"] < first["foreseen"]["low"]
    kept = second["foreseen"]["mean"] if second["handed_over"] else second["foreseen_with_old"]
    assert abs(kept - short["throughput"]) < abs(first["foreseen"]["mean"] - short["throughput"]) / 2
    assert alarm["alarm"]
    assert CHANGE < alarm["alarm_slot"] <= CHANGE + 300
    assert abs(alarm["changed_since"] - CHANGE) <= 100
    assert diagnosis["forgotten"] == ["arrivals[0]"]
    assert all(entry["why"] for entry in entries)
    assert entries[-1]["slots"][1] == case.loop.slots


def test_a_twin_that_learns_again_delivers_more(case, runs):
    """By exact long-run averages of the policies that are in force at the end, on the network after the change."""
    again, _, once = runs
    assert once.round == 1
    network = chain(Network.reference().without(1))
    learned, kept = (average(network, np.clip(s.policy, 1e-5, 1 - 1e-5)).throughput for s in (again, once))
    assert learned > kept + 0.02


def test_a_log_is_played_to_its_end_and_no_further(case):
    rows = connect(case).play(TURNS, 60, np.random.default_rng(0))
    logged = LoggedNetwork(rows)
    parts = [logged.play(TURNS, 40, np.random.default_rng(1)) for _ in range(3)]
    assert [len(part["slot"]) for part in parts] == [40, 20, 0]
    assert np.array_equal(np.concatenate([part["ack"] for part in parts]), rows["ack"])
    other = LoggedNetwork({name: column + (name == "ack") for name, column in rows.items()})
    with pytest.raises(InputError, match="the same ack as before"):
        other.go_on(parts[0])


def test_luck_that_cannot_be_repeated_is_noticed_or_allowed():
    rows = PlayedNetwork(changing_network(), 0, 1, replay=True).play(TURNS, 50, np.random.default_rng(0))
    with pytest.raises(InputError, match="replay = false"):
        PlayedNetwork(changing_network(), 1, 1, replay=True).go_on(rows)
    other = PlayedNetwork(changing_network(), 1, 1, replay=False)
    other.go_on(rows)
    assert other.play(TURNS, 3, np.random.default_rng(0))["episode"].tolist() == [1, 1, 1]
    again = PlayedNetwork(changing_network(), 0, 1, replay=False)
    again.go_on(rows)
    assert not np.array_equal(again.play(TURNS, 50, np.random.default_rng(0))["arrival"], rows["arrival"])


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('environment = "multi_access"', "", "an environment or a log"),
        ('environment = "multi_access"', 'environment = "multi_acess"', "'multi_access', or"),
        ("diagnose = 0", "diagnos = 0", "'diagnose'"),
        ("slots = 1000", "slots = 0", "1 or more"),
        ("slots = 1000", "slots = 1000\nwindow = 2000", "[loop] window: expected at most the 1000 slots"),
        ("[[0, 1], [2, 3]]", "[[0, 1], [2]]", "3 devices"),
        ("[[0, 1], [2, 3]]", "[[0, 1.5], [2, 3]]", "clusters: expected lists of devices' numbers"),
        ("[[0, 1], [2, 3]]", "[[false, true], [2, 3]]", "clusters: expected lists of devices' numbers"),
        ("[[0, 1], [2, 3]]", "[0, 1]", "options: expected values of the right type"),
        ('name = "multi_access"', 'name = "received_power"', "'multi_access', which can be controlled"),
        ("disconnect = [[500, 1]]", "disconnect = [[500, 7]]", "one of 0 to 3"),
        ("disconnect = [[500, 1]]", "disconect = [[500, 1]]", "what multi_access takes"),
        ('environment = "multi_access"', 'environment = "own:made"', "--no-code"),
        ('environment = "multi_access"', 'log = "no.csv"', "no.csv"),
        ("[loop]", '[effects]\nuse = "device_disconected"\n[loop]', "Did you mean 'device_disconnected'?"),
        ("[loop]", '[effects]\nexclude = ["bias"]\n[loop]', "[effects] exclude: expected one of"),
        ("[loop]", '[effects]\nknown = ["drift"]\n[loop]', "[effects] known: expected nothing"),
        ("clusters", "capacity = 1.5\nclusters", "options capacity: expected a whole number, got 1.5"),
        ("clusters", 'traffic = ["markov"]\nclusters', "options traffic: expected text"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(tmp_path, capsys, old, new, told):
    (tmp_path / "twin.toml").write_text(CASE.replace(old, new, 1 if old.startswith("name") else -1))
    arguments = ["twin", "run", str(tmp_path / "twin.toml"), "--out", str(tmp_path / "out"), "--no-code"]
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert told in error


def test_a_state_of_another_case_is_refused(case, tmp_path):
    save(begin(case), case, tmp_path / "state.npz")
    other = dataclasses.replace(case, loop=dataclasses.replace(case.loop, window=20))
    with pytest.raises(InputError, match="the state of this case"):
        load(other, tmp_path / "state.npz")


def test_what_people_read_is_written_though_the_run_had_ended(case, tmp_path):
    """A run that was killed between its last state and history.json."""
    rows = connect(case).play(TURNS, 20, np.random.default_rng(0))
    save(begin(case)._replace(rows=rows, phase="done"), case, tmp_path / "state.npz")
    assert main(["twin", "run", str(case.path), "--out", str(tmp_path), "--resume"]) == 0
    told = json.loads((tmp_path / "history.json").read_text())
    assert told["finished"]
    assert told["slots"] == 20
    assert (tmp_path / "log.csv").is_file()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut off", b"no archive"])
def test_what_is_no_state_is_refused(case, tmp_path, content):
    (tmp_path / "state.npz").write_bytes(content)
    with pytest.raises(InputError, match="Begin without --resume"):
        load(case, tmp_path / "state.npz")


class Scaled:
    """A network whose one device sees its buffer as a share of the capacity."""

    possible_agents = ("device_0",)

    def reset(self, **_):
        return {"device_0": np.array([0.5, 0.0, 1.0])}, {}


def test_a_buffer_that_is_no_number_of_packets_is_refused():
    with pytest.raises(InputError, match="observation of the physical twin: expected packets"):
        PlayedNetwork(Scaled(), 0, 2, replay=True)
