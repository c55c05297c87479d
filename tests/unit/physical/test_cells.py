"""Which cells an effect touches."""

import hashlib
import json

import numpy as np
import pytest

from dtprob.physical import custom_cases, disturbances, front_end, labels_cases
from dtprob.physical.cases import _cells
from dtprob.physical.cells import touched
from dtprob.physical.multi_access import cases as network_cases
from dtprob.physical.multi_access.faults import LISTED, draw
from dtprob.physical.multi_access.likeness import likeness
from tests.unit.physical.test_network_cases import NETWORK


def test_a_block_is_found_along_its_axis():
    energy = np.full((6, 10), 1e-3)
    energy[:, 4:7] = 1.0
    assert touched(energy, ("link", "subcarrier"), 100.0) == {"subcarrier": [4, 5, 6]}


def test_what_is_everywhere_or_cannot_be_told_is_nowhere():
    assert touched(np.ones((6, 10)), ("link", "subcarrier"), 1e6) == {}
    assert touched(np.zeros(8), ("link",), 100.0) == {}
    scattered = np.zeros(20)
    scattered[::4] = 1.0
    assert touched(scattered, ("link",), 50.0) == {}  # 9 for each of five cells
    assert touched(scattered, ("link",), 100.0) == {"link": [0, 4, 8, 12, 16]}
    assert touched(np.repeat([1.0, 0.0], [4, 12]), ("link",), 50.0) == {"link": [0, 1, 2, 3]}
    assert touched(np.repeat([1.0, 0.0], [4, 12]), ("link",), 50.0, ("link",)) == {}


@pytest.mark.parametrize("track", [labels_cases.TRACK, custom_cases.TRACK, network_cases.TRACK])
def test_every_track_makes_every_kind(track, tmp_path):
    """The key knows what looks like the truth, which cells are touched, and the cases by their hashes."""
    key = json.loads(track.generate(tmp_path, len(track.kinds), 2, track.kinds, 60.0).read_text())
    assert {case["kind"] for case in key["cases"]} == {
        "null",
        "listed",
        "unlisted",
        "pair",
        "triple",
        "alias",
    }
    for case in key["cases"]:
        count = {"null": 0, "pair": 2, "triple": 3}.get(case["kind"], 1)
        assert len({effect["family"] for effect in case["effects"]}) == count
        assert isinstance(case["cells"], dict)
        for name, digest in case["sha256"].items():
            file = tmp_path / "cases" / case["name"] / name
            assert hashlib.sha256(file.read_bytes()).hexdigest() == digest
        if case["kind"] == "alias":
            assert case["alias"]["name"] != case["effects"][0]["name"]
            assert 0.2 < case["alias"]["correlation"] <= 1.0


def test_traffic_of_one_device_touches_its_cluster(tmp_path):
    for family in ("arrival_rate_shift", "periodic_traffic"):
        folder = tmp_path / family
        network_cases.TRACK.generate(folder, 1, 0, ("listed",), 60.0, families=(family,))
        truth = json.loads((folder / "truth" / "0000.json").read_text())
        device = int(truth["effects"][0]["instance"].removeprefix("device_"))
        assert truth["cells"] == {"cluster": [device // 2]}


def test_what_makes_the_noise_louder_touches_its_cells(bench, setting):
    chain = disturbances.noise_imbalance(np.array([0.0, 2.0, 0.0, 0.0]))
    quiet = disturbances.noise_imbalance(np.array([0.0, 0.0, -2.0, 0.0]))
    assert touched_by(bench, chain, 1.0) == {"rx_antenna": [1]}
    assert touched_by(bench, quiet, 1.0) == {"rx_antenna": [2]}
    near = np.argmax(np.mean(np.abs(bench.base.mean) ** 2, axis=(1, 2, 3, 4)))
    assert near in touched_by(bench, front_end.quantization(), 0.05)["link"]


def touched_by(bench, impairment, size):
    return _cells(bench, bench.simulate((impairment, size)), 1e4)


def test_network_faults_are_like_themselves_and_unlike_the_others():
    rng = np.random.default_rng(0)
    faults = [(draw(rng, family, NETWORK), 0.3) for family in LISTED[::3]]
    for one in faults:
        assert likeness(NETWORK, one, one) == pytest.approx(1.0)
        for other in faults:
            assert 0 <= likeness(NETWORK, one, other) <= 1 + 1e-9
            if (one[0].arrivals is None) != (other[0].arrivals is None):
                assert likeness(NETWORK, one, other) == 0.0
