"""Beam alignment on a street made by hand: line of sight and one wall, no ray tracing."""

import jax
import numpy as np
import pytest

from dtprob.models.prediction_powered.schemes import SCHEMES
from dtprob.reproduce import beam_alignment, fig9, fig10, fig10_learned
from dtprob.reproduce.beam_alignment import Campaign, Case
from dtprob.reproduce.beam_findings import gain, standing
from dtprob.reproduce.beam_maps import MAPS, interpolated
from dtprob.reproduce.beams import BeamPaths, Site
from dtprob.reproduce.beams_codebook import (
    VERTICAL,
    Arrays,
    chosen,
    coefficients,
    gathered,
    grid,
    labels,
    rates,
    response,
)
from dtprob.reproduce.beams_file import read_paths, write_paths
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
    parts = (gain, cosines[..., 1], cosines[..., 2], -cosines[..., 0])
    return BeamPaths(position, *(np.take_along_axis(part, order, axis=1) for part in parts))


@pytest.fixture(scope="module")
def paths():
    return street()


def test_response_is_the_inner_product_of_two_steering_vectors():
    antenna = np.arange(7)
    for beam, path in ((0.3, 0.3), (0.25, -0.6), (-1.0, 1.0)):
        vectors = [np.exp(1j * np.pi * antenna * cosine) / np.sqrt(7) for cosine in (beam, path)]
        assert response(7, np.array(path - beam)) == pytest.approx(np.vdot(*vectors), abs=1e-12)


@pytest.mark.parametrize("elements", [1, 2, 7])
def test_coefficients_tell_what_beams_gather(elements):
    random = np.random.default_rng(elements)
    power, cosine = random.random((4, 3)), random.uniform(-1, 1, (4, 3))
    share = power / power.sum(axis=1, keepdims=True)
    each = np.abs(response(elements, cosine[..., None] - grid(elements))) ** 2
    direct = np.sum(share[..., None] * each, axis=1)
    found = coefficients(power, cosine, elements)
    np.testing.assert_allclose(gathered(found, elements), direct, atol=1e-12)
    distances = [np.sum((rows[0] - rows[1]) ** 2) for rows in (found, direct)]
    assert distances[0] == pytest.approx(distances[1], abs=1e-12)


def test_all_beams_of_a_line_gather_all_power_as_often_as_they_are_oversampled():
    found = gathered(coefficients(np.array([[1.0, 3.0]]), np.array([[0.123, -0.7]]), 8), 8)
    assert found.shape == (1, 32)
    assert found.sum() == pytest.approx(4)
    assert grid(8)[np.argmax(found)] == pytest.approx(-0.7, abs=1 / 32)


def test_the_rate_is_that_of_the_channel(paths):
    arrays, beams = Arrays(4, user=2), np.array([[9, 13, 6]])
    one = BeamPaths(*(part[:1] for part in paths))

    def steering(elements, cosine):
        return np.exp(1j * np.pi * np.arange(elements) * cosine)

    channel = sum(
        gain * np.outer(steering(2, w), np.kron(steering(4, u), steering(VERTICAL, v)))
        for gain, u, v, w in zip(one.gain[0], one.horizontal[0], one.vertical[0], one.arrival[0], strict=True)
    )
    sent = np.kron(steering(4, grid(4)[9]), steering(VERTICAL, grid(VERTICAL)[13])) / np.sqrt(4 * VERTICAL)
    received = steering(2, grid(2)[6]) / np.sqrt(2)
    # 40 dBm over 10 MHz at -174 dBm/Hz
    expected = np.log2(1 + 10**14.4 * np.abs(received.conj() @ channel @ sent.conj()) ** 2)
    assert rates(one, beams, arrays)[0] == pytest.approx(expected, rel=1e-10)


def test_a_second_antenna_doubles_the_power_along_one_path(paths):
    single = paths._replace(gain=paths.gain * [1, 0])
    gains = []
    for user in (1, 2):
        arrays = Arrays(8, user)
        gains.append(rates(single, chosen(labels(single, arrays), arrays), arrays))
    # At this signal-to-noise ratio twice the power is one bit more, but for beams beside the direction.
    there = gains[0] > 10
    assert np.max(np.abs(gains[1] - gains[0] - 1)[there]) < 0.08


@pytest.mark.parametrize("kind", MAPS)
def test_a_map_is_right_where_it_was_told_and_errs_between(paths, kind):
    arrays, known = Arrays(10), BeamPaths(*(part[::3] for part in paths))
    truth, error = labels(paths, arrays), MAPS[kind](known, paths.position, arrays)
    squared = np.sum((error - truth) ** 2, axis=1) / np.sum(np.var(truth, axis=0))
    told = np.arange(len(squared)) % 3 == 0
    assert squared[told].mean() < 0.02
    assert 2 * squared[told].mean() < squared[~told].mean() < 0.5


def test_interpolated_paths_are_those_of_known_positions_there(paths):
    known = BeamPaths(*(part[::3] for part in paths))
    at_home, there = interpolated(known, known.position), np.abs(known.gain) > 0
    np.testing.assert_allclose(at_home.horizontal[there], known.horizontal[there], atol=1e-5)
    np.testing.assert_allclose(np.abs(at_home.gain), np.abs(known.gain), atol=1e-8)


def test_paths_come_back_from_their_file(paths, tmp_path):
    write_paths(paths, tmp_path / "paths.npz")
    found = read_paths(tmp_path / "paths.npz")
    np.testing.assert_allclose(found.gain, paths.gain, atol=0.02 * np.abs(paths.gain).max())
    np.testing.assert_allclose(np.abs(found.gain), np.abs(paths.gain), rtol=1e-3)
    there = np.abs(paths.gain) > 0
    np.testing.assert_allclose(found.arrival[there], paths.arrival[there], atol=2e-5)


def test_the_file_that_comes_with_dtprob_holds_the_positions():
    found = read_paths()
    assert found.position.shape == (38_038, 2)
    assert len(np.unique(found.position, axis=0)) == 38_038
    amplitude = np.abs(found.gain)
    assert np.all(amplitude[:, 0] > 0)
    assert np.all(np.diff(amplitude, axis=1) <= 1e-3 * amplitude[:, :1])
    # No path is stronger than free space allows at the shortest distance, 28.5 m of height.
    assert amplitude.max() <= 1.01 * 299_792_458 / 28e9 / (4 * np.pi * 28.5)


def test_labels_help_and_synthetic_ones_help_more(paths):
    few, many = (beam_alignment.study(KEY, paths, Case(Arrays(10), n)) for n in (40, 300))
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


def test_figure_10_states_gain_and_shortfall(paths):
    campaign = Campaign(KEY, 2, Progress(), paths)
    found = fig10.figure(campaign, (30, 60))
    learned = fig10_learned.figure(campaign, (30, 60))
    for panel in (*found.panels, *learned.panels):
        assert [series.name for series in panel.series] == list(SCHEMES)
    gain = next(note for note in found.notes if "mean gain over erm at 30" in note)
    cases = campaign.cell(Case(Arrays(fig10.ROWS), 30))
    assert f"{np.mean(cases[:, 5, 0] - cases[:, 0, 0]):.3f} bit/s/Hz" in gain
    # A second antenna gives what a second antenna can, half of it at the least.
    one, two = (panel.series[5].median for panel in found.panels)
    assert np.all(np.abs(two - one - 0.75) < 0.25)


def test_findings_tell_where_the_tuned_scheme_is_not_the_best():
    rate = np.arange(5.0)[:, None, None] * np.ones((len(SCHEMES), 2))
    tuned = list(SCHEMES).index("tuned_cppi")
    rate[:, tuned] += [0.5, -1.25]
    assert gain(rate, [30, 60], 30) == "mean gain over erm at 30: 0.500 bit/s/Hz, 90% interval 0.500 to 0.500"
    text = standing(rate, [30, 60])
    assert "the highest at 1 of 2 points, the best other at or below its upper quartile at 1;" in text
    assert "worst at 60: 1.250 bit/s/Hz below erm, with quartiles -0.250 and 1.750 around 0.750" in text
    assert "mean difference -1.250 bit/s/Hz" in text
    assert standing(rate[..., :1], [30]) == "median of tuned_cppi the highest at 1 of 1 points"
