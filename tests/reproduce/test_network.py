"""Figure 2 and the collection study in small: data are counted right, twins are what they should be, all parts fit."""

import json

import jax
import numpy as np
import pytest

from dtprob.control import COMA, Budget, aloha
from dtprob.reproduce import fig2, network_collection
from dtprob.reproduce.collection_bound import expected_errors, least_errors
from dtprob.reproduce.network_study import NETWORK, Campaign, collect, counts, law, learned, mode, record
from dtprob.reproduce.progress import Progress

KEY = jax.random.key(0)
ZERO = {"log_arrival": np.zeros((2, 1, 4)), "log_reception": np.zeros((5, 5))}


def test_collected_counts_follow_the_tables():
    seen = collect(KEY, 21, 400)
    assert seen["log_reception"].shape == (400, 20, 5, 5)
    assert np.all(seen["log_reception"].sum(axis=(2, 3)) == 1)
    assert np.all(seen["log_arrival"].sum(axis=(3, 4)) == 1)
    total = seen["log_reception"].sum(axis=(0, 1))
    for senders, row in enumerate(total):
        error = 4 * np.sqrt(0.25 / row.sum())
        np.testing.assert_allclose(row / row.sum(), NETWORK.reception[senders], atol=error)
    np.testing.assert_allclose(
        seen["log_arrival"].mean(axis=(0, 1))[:, 0], NETWORK.arrival[:, 0], atol=4 * np.sqrt(0.25 / 8000)
    )


def test_counts_are_those_of_the_record():
    played = jax.tree.map(lambda leaf: np.asarray(leaf)[None, :, 0], record(KEY, aloha(4, 1, 0.6), 30))
    seen = counts(played)
    sends = (played.action * (played.observation.buffer > 0)).sum(-1)[0, :-1]
    assert np.array_equal(seen["log_reception"][0].sum(axis=-1).argmax(axis=-1), sends)
    arrival = played.observation.arrival[0, 1:, 2:] @ [2, 1]
    assert np.array_equal(seen["log_arrival"][0, :, 1, 0].argmax(axis=-1), arrival)


def test_points_are_the_textbooks():
    seen = {**ZERO, "log_reception": ZERO["log_reception"].copy()}
    seen["log_reception"][2, :3] = [0, 3, 1]
    likely = learned("maximum_likelihood", seen).sample(KEY, 2)
    np.testing.assert_allclose(np.exp(likely["log_reception"][1, 2]), [0, 0.75, 0.25, 0, 0], atol=1e-12)
    np.testing.assert_allclose(np.exp(likely["log_arrival"][0]), 0.25)
    likeliest = learned("map", seen).sample(KEY, 1)
    np.testing.assert_allclose(
        np.exp(likeliest["log_reception"][0, 2, :3]), np.array([0.01, 3.01, 1.01]) / 4.03
    )
    np.testing.assert_allclose(mode(np.array([3.0, 1.0, 0.0])), [1, 0, 0])
    drawn = np.exp(learned("bayesian", seen).sample(KEY, 4000)["log_reception"][:, 2, :3])
    mean, total = np.array([0.01, 3.01, 1.01]) / 4.03, 4.03
    error = 4 * np.sqrt(mean * (1 - mean) / (total + 1) / 4000)
    assert np.all(np.abs(drawn.mean(axis=0) - mean) < error)


@pytest.mark.study
def test_the_figure_in_small(tmp_path):
    campaign = Campaign(COMA(), Budget(640, 8, 20), starts=0)
    with jax.enable_x64(False):  # as `run` does; one part asks for double precision
        found = fig2.figure(KEY, 2, Progress(folder=tmp_path / "parts"), (0, 4), campaign)
    names = [series.name for series in found.panels[0].series]
    assert names == [*fig2.LINES, "oracle", "tdma", "aloha"]
    level = {series.name: series.median for series in found.panels[0].series}
    np.testing.assert_allclose(level["tdma"], 1.0598, atol=5e-5)
    np.testing.assert_allclose(level["aloha"], 0.7786, atol=5e-5)
    assert all(0.3 < value < 1.1625 for values in level.values() for value in values)
    assert json.dumps(found.to_dict(seed=0, command="", seconds=1.0))
    kept = len(list((tmp_path / "parts").iterdir()))
    assert kept == 2 * len(fig2.LINES) + 3  # lines and sizes; oracle, policies that remember, local rules


def test_errors_fall_with_counts_and_are_zero_in_the_limit():
    seen = {"log_reception": np.repeat(NETWORK.reception[None, None] * 1e6, 2, axis=1)}
    assert network_collection.errors(seen)[0, 1] < 1e-4
    empty = network_collection.errors({"log_reception": np.zeros((1, 1, 5, 5))})
    uniform = [0.5, 1 - (1 / 3 + 0.2), 0.75, 0.8]
    assert empty[0, 0] == pytest.approx(np.mean(uniform))
    assert law(ZERO, 0.5).concentration["log_reception"][3].tolist() == [0.5] * 4 + [0.0]


def test_the_best_collector_against_closed_forms_and_chance():
    certain = expected_errors(NETWORK.reception[3, :4], 0.5, 3)
    np.testing.assert_allclose(certain, 1.5 / (2 + np.arange(4)))
    best = least_errors(NETWORK, 0.5, 8)
    start = np.mean([0.5, 1 - (1 / 3 + 0.2), 0.75, 0.8])
    np.testing.assert_allclose(best[:2], start, atol=1e-6)  # buffers are empty in the first slot
    sent_by_one = (1 - 0.2**2) * (0.5 - 0.25) / 4  # what teaches most in the second, unless no packet came
    assert best[2] == pytest.approx(start - sent_by_one, abs=1e-6)
    chance = network_collection.errors(collect(KEY, 9, 400)).mean(axis=0)
    assert np.all(np.diff(best[1:]) < 0)
    assert np.all(best[1:] <= chance + 1e-6)
