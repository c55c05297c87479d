"""Faults of networks and the withheld cases made of them: laws, information, and the same bytes from the same seed."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dtprob.case import load_case
from dtprob.data import read
from dtprob.errors import InputError
from dtprob.physical.multi_access.cases import TRACK
from dtprob.physical.multi_access.divergence import information
from dtprob.physical.multi_access.fault import Past, subsets
from dtprob.physical.multi_access.faults import FAMILIES, FOREIGN, LISTED, draw
from dtprob.physical.multi_access.log import record, sound_acks
from dtprob.physical.multi_access.network import Network, reception

NETWORK = Network(
    ((0, 1), (2, 3)),
    1,
    np.tile([0.2, 0.35, 0.35, 0.1], (2, 1, 1)),
    reception([0.9], [0.7, 0.2], [0.3, 0.1], [0.1, 0.05], senders=4),
)


def laws(fault, size, past):
    rows, acks = NETWORK.arrival[:, 0], sound_acks(NETWORK)
    rows = fault.arrivals(rows, past, size) if fault.arrivals else rows
    return rows, fault.acks(acks, past, size) if fault.acks else acks


@pytest.mark.parametrize("family", FAMILIES)
def test_every_fault_keeps_laws_and_does_nothing_at_size_zero(family):
    fault = draw(np.random.default_rng(0), family, NETWORK)
    sound = laws(fault, 0.0, Past(7, 0.5, np.ones(4, int)))
    np.testing.assert_allclose(sound[0], NETWORK.arrival[:, 0], atol=1e-12)
    np.testing.assert_allclose(sound[1].sum(axis=1), 1, atol=1e-12)
    past = Past(7, 0.9, np.ones(4, int), memory=fault.start(0.4))
    rows, acks = laws(fault, 0.4, past)
    np.testing.assert_allclose(rows.sum(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(acks.sum(axis=1), 1, atol=1e-12)
    assert min(rows.min(), acks.min()) >= 0
    sets = subsets(4)
    assert np.all(acks[~np.all(sets[None] <= sets[:, None], axis=2)] == 0)
    assert not (np.allclose(rows, sound[0]) and np.allclose(acks, sound[1]))


def test_log_follows_the_laws():
    log = record((0,), NETWORK, 20_000)
    joint = 2 * log.arrival[:, 0] + log.arrival[:, 1]
    frequency = np.bincount(joint, minlength=4) / len(joint)
    np.testing.assert_allclose(frequency, NETWORK.arrival[0, 0], atol=4 * np.sqrt(0.25 / 20_000))
    senders = (log.action * (log.buffer > 0)).sum(axis=1)
    for count in (1, 2):
        seen = log.ack[senders == count].sum(axis=1)
        expected = NETWORK.reception[count, : count + 1]
        error = 4 * np.sqrt(0.25 / len(seen))
        np.testing.assert_allclose(np.bincount(seen, minlength=count + 1) / len(seen), expected, atol=error)


def test_information_is_that_of_the_likelihood_ratio():
    """A source more at one device: the divergence per slot is that of two rows of a table from their mean."""
    fault = draw(np.random.default_rng(0), "arrival_rate_shift", NETWORK)
    found = information(NETWORK, fault, 0.3, before=3000, after=500)
    device = int(fault.instance.split("_")[1])
    row, has = NETWORK.arrival[0, 0], (np.arange(4) >> (1 - device % 2)) & 1
    new = np.where(has == 1, row + 0.3 * row[np.arange(4) ^ (2 if device % 2 == 0 else 1)], 0.7 * row)
    fitted = (6 * row + new) / 7
    expected = 500 * np.sum(new * np.log(new / fitted)) + 3000 * np.sum(row * np.log(row / fitted))
    assert found == pytest.approx(2 * expected, rel=1e-9)


def test_what_a_table_can_fit_is_no_information():
    fault = draw(np.random.default_rng(0), "reception_shift", NETWORK)
    assert information(NETWORK, fault, 0.5, before=1, after=5000) < 1
    assert information(NETWORK, fault, 0.5, before=5000, after=5000) > 10
    for family in FAMILIES:
        fault = draw(np.random.default_rng(0), family, NETWORK)
        assert information(NETWORK, fault, 0.0, before=3000, after=600) == pytest.approx(0, abs=1e-6)


def divergence(log, laws):
    """Sum over the slots of a log of the divergence of the laws it followed from the sound ones."""
    senders = (log.action * (log.buffer > 0)) @ [8, 4, 2, 1]
    sound, total = {"arrivals": NETWORK.arrival[:, 0], "acks": sound_acks(NETWORK)}, 0.0
    for kind, rows in laws.items():
        for law, sent in zip(rows, senders, strict=True):
            one, other = (each if kind == "arrivals" else each[sent] for each in (law, sound[kind]))
            total += np.sum(one[one > 0] * np.log(one[one > 0] / other[one > 0]))
    return total


@pytest.mark.parametrize(
    "family",
    [family for family in FAMILIES if family not in ("arrival_rate_shift", "near_far", "reception_shift")],
)
def test_information_is_the_mean_over_logs(family):
    """A sound log so much longer than the other that the fit to both is the sound network."""
    fault = draw(np.random.default_rng(1), family, NETWORK)
    kind = "arrivals" if fault.acks is None else "acks"
    found = []
    for seed in range(12):
        laws = []

        def spy(law, past, size, laws=laws):
            laws.append(getattr(fault, kind)(law, past, size))
            return laws[-1]

        log = record((seed,), NETWORK, 300, [(replace(fault, **{kind: spy}), 0.3)])
        found.append(2 * divergence(log, {kind: laws}))
    expected = information(NETWORK, fault, 0.3, before=100_000, after=300)
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert np.mean(found) == pytest.approx(expected, abs=4 * error + 0.02 * expected)


@pytest.mark.parametrize("family", FAMILIES)
def test_laws_repeat_after_their_period(family):
    fault = draw(np.random.default_rng(0), family, NETWORK)
    pasts = [Past(slot, slot / 600, np.ones(4, int), fault.start(0.4)) for slot in range(600)]
    every = [np.concatenate([law.reshape(-1) for law in laws(fault, 0.4, past)]) for past in pasts]
    repeats = [period for period in range(1, 30) if np.array_equal(every[period:], every[:-period])]
    assert (repeats[0] if repeats else None) == fault.period


def test_an_outage_is_remembered():
    fault = draw(np.random.default_rng(0), "bursty_channel", NETWORK)
    bad = fault.start(0.2)
    heard = fault.follow(bad, 0.5, False, 0.2)
    silent = fault.follow(bad, 0.1, True, 0.2)
    assert heard == pytest.approx(0.2 / 0.8 / 8)
    assert silent > bad > heard
    share = np.mean(record((2,), NETWORK, 20_000, [(fault, 0.2)]).ack.sum(1) == 0)
    assert share > np.mean(record((2,), NETWORK, 20_000).ack.sum(1) == 0)


@pytest.mark.study
@pytest.mark.parametrize("family", [None, "ack_loss", "capture", "near_far", "duty_cycle"])
def test_an_outage_is_remembered_beside_other_faults(family):
    """The memory is the chance of an outage given the past, so that on average it is what it started with."""
    outage = draw(np.random.default_rng(0), "bursty_channel", NETWORK)
    memories = []

    def follow(bad, *seen):
        memories.append(outage.follow(bad, *seen))
        return memories[-1]

    faults = [(replace(outage, follow=follow), 0.3)]
    if family is not None:
        faults.append((draw(np.random.default_rng(0), family, NETWORK), 0.45))
    record((3,), NETWORK, 6000, faults)
    # The memory is forgotten within some ten slots, so that its mean strays by 0.01.
    assert np.mean(memories) == pytest.approx(0.3, abs=0.03)
    first, second = (record((3,), NETWORK, 300, each).ack for each in (faults, faults[::-1]))
    np.testing.assert_array_equal(first, second)


@pytest.mark.study
def test_cases(tmp_path):
    for name in ("first", "second"):
        TRACK.generate(tmp_path / name, 4, 3, lambda_=100.0)
    files = sorted(path.relative_to(tmp_path / "first") for path in (tmp_path / "first").rglob("*.*"))
    assert [file.read_bytes() for file in (tmp_path / "first" / f for f in files)] == [
        file.read_bytes() for file in (tmp_path / "second" / f for f in files)
    ]
    key = json.loads((tmp_path / "first" / "key.json").read_text())
    assert key["track"] == "network"
    assert [case["kind"] for case in key["cases"]] == ["null", "listed", "unlisted", "pair"]
    assert [len(case["effects"]) for case in key["cases"]] == [0, 1, 1, 2]
    for case in key["cases"]:
        folder = tmp_path / "first" / "cases" / case["name"]
        assert load_case(folder / "case.toml").model.name == "multi_access"
        assert len(read(folder / "after.csv").slot) == 600
        for effect in case["effects"]:
            assert effect["lambda"] == pytest.approx(100, rel=0.15)
    unlisted = key["cases"][2]
    family = unlisted["effects"][0]["family"]
    assert unlisted["excluded"] == ([] if family in FOREIGN else [family])


def test_wrong_requests(tmp_path):
    assert set(LISTED) | set(FOREIGN) == set(FAMILIES)
    with pytest.raises(InputError, match="kinds"):
        TRACK.generate(tmp_path, 1, 0, kinds=("quadruple",))
    with pytest.raises(InputError, match="family of faults"):
        draw(np.random.default_rng(0), "weather", NETWORK)
