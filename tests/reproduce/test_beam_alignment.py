"""Beam alignment on a street made by hand: line of sight and one wall, no ray tracing."""

import jax
import numpy as np
import pytest

from dtprob.models.prediction_powered.schemes import SCHEMES
from dtprob.reproduce import beam_alignment, fig9, fig10
from dtprob.reproduce.beam_alignment import Campaign, knowledge_map, labels
from dtprob.reproduce.beams import BeamPaths, Site
from dtprob.reproduce.beams_codebook import VERTICAL, Beams, grid, rates, response, shares
from dtprob.reproduce.progress import Progress

KEY = jax.random.key(4)


def street(side=25):
    """A square of positions; beyond 60 m the line of sight is blocked and only a wall along x reflects."""
    axis = np.linspace(-60.0, 60.0, side)
    position = np.stack(np.meshgrid(axis + 40, axis), axis=-1).reshape(-1, 2) + Site().position[:2]
    steps = np.column_stack([position, np.full(len(position), 1.5)]) - np.array(Site().position)
    mirrored = steps * [1, -1, 1] + [0, 150, 0]
    length = np.stack([np.linalg.norm(path, axis=1) for path in (steps, mirrored)], axis=1)
    gain = 8.5e-4 / length * np.array([1.0, 0.4]) * np.exp(2j * np.pi * length / 0.0107)
    gain[length[:, 0] > 60, 0] = 0
    cosines = np.stack([steps, mirrored], axis=1) / length[..., None]
    order = np.argsort(-np.abs(gain), axis=1)
    parts = (gain, cosines[..., 1], cosines[..., 2])
    return BeamPaths(position, *(np.take_along_axis(part, order, axis=1) for part in parts))


@pytest.fixture(scope="module")
def paths():
    return street()


def test_response_is_the_inner_product_of_two_steering_vectors():
    antenna = np.arange(7)
    for beam, path in ((0.3, 0.3), (0.25, -0.6), (-1.0, 1.0)):
        vectors = [np.exp(1j * np.pi * antenna * cosine) / np.sqrt(7) for cosine in (beam, path)]
        assert response(7, np.array(path - beam)) == pytest.approx(np.vdot(*vectors), abs=1e-12)


def test_the_beams_of_a_line_gather_all_power_as_often_as_they_are_oversampled():
    gathered = shares(np.array([[1.0, 3.0]]), np.array([[0.123, -0.7]]), 8)
    assert gathered.shape == (1, 32)
    assert gathered.sum() == pytest.approx(4)
    assert grid(8)[np.argmax(gathered)] == pytest.approx(-0.7, abs=1 / 32)


def test_the_rate_is_that_of_the_channel(paths):
    rows, beams = 4, Beams(np.array([9]), np.array([13]))
    one = BeamPaths(*(part[:1] for part in paths))
    vectors = [
        np.kron(np.exp(1j * np.pi * np.arange(rows) * u), np.exp(1j * np.pi * np.arange(VERTICAL) * v))
        for u, v in [
            (grid(rows)[9], grid(VERTICAL)[13]),
            *zip(one.horizontal[0], one.vertical[0], strict=True),
        ]
    ]
    channel = np.sum(one.gain[0][:, None] * np.array(vectors[1:]), axis=0)
    beam = vectors[0] / np.sqrt(rows * VERTICAL)
    # 40 dBm over 10 MHz at -174 dBm/Hz
    expected = np.log2(1 + 10**14.4 * np.abs(np.vdot(beam, channel)) ** 2)
    assert rates(one, beams, rows)[0] == pytest.approx(expected, rel=1e-10)


def test_the_map_knows_its_own_positions_and_errs_between(paths):
    known = BeamPaths(*(part[::3] for part in paths))
    at_home = knowledge_map(known, known.position)
    there = np.abs(known.gain) > 0
    np.testing.assert_allclose(at_home.horizontal[there], known.horizontal[there], atol=1e-5)
    between = labels(knowledge_map(known, paths.position), 10) - labels(paths, 10)
    assert 0.001 < np.mean(between**2) < 0.1


def test_labels_help_and_synthetic_ones_help_more(paths):
    few, many = (beam_alignment.study(KEY, paths, 10, n) for n in (40, 300))
    names = list(SCHEMES)
    erm, tuned = names.index("erm"), names.index("tuned_cppi")
    assert many[erm, 0] > few[erm, 0]
    assert few[tuned, 0] > few[erm, 0]
    assert few[erm, 1] == 0
    assert 0 < few[tuned, 1] <= 1


def test_figures_have_every_scheme_and_resume(paths, tmp_path):
    campaign = Campaign(KEY, 2, Progress(folder=tmp_path), paths)
    wide = fig9.figure(campaign, (4, 8), (30, 60))
    assert [panel.title for panel in wide.panels] == ["30 labelled positions", "60 labelled positions"]
    assert [list(series.x) for series in wide.panels[0].series[:1]] == [[40, 80]]
    parts = {file: file.stat().st_mtime_ns for file in tmp_path.iterdir()}
    assert len(parts) == 8
    again = fig9.figure(campaign, (4, 8), (30, 60))
    assert {file: file.stat().st_mtime_ns for file in tmp_path.iterdir()} == parts
    np.testing.assert_array_equal(again.panels[1].series[5].median, wide.panels[1].series[5].median)
    narrow = fig10.figure(campaign, (30, 60))
    assert [series.name for series in narrow.panels[0].series] == list(SCHEMES)
    assert "mean lambda of tuned_cppi" in narrow.notes[-1]


def test_what_is_kept_is_computed_once(tmp_path):
    progress, calls = Progress(folder=tmp_path / "parts"), []

    def compute():
        calls.append(1)
        return {"a": np.arange(3)}

    for _ in range(2):
        np.testing.assert_array_equal(progress.kept("shared", compute)["a"], np.arange(3))
    assert calls == [1]
    assert (tmp_path / "shared.npz").is_file()
