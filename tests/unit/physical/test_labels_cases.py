"""Surveys of labels with faults: laws, information in closed form, and the same bytes from the same seed."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dtprob.case import load_case
from dtprob.data import read
from dtprob.errors import InputError
from dtprob.physical.fault_cases import Families, choose
from dtprob.physical.gaussian import Bench, Law, information, louder, measure, shifted, shown, sized, visible
from dtprob.physical.labels_cases import TRACK
from dtprob.physical.labels_faults import FAMILIES, FOREIGN, LISTED, draw
from dtprob.physical.labels_survey import BLOCKS, EAST, NORTH, ROWS, make_survey

SURVEY = make_survey(np.random.default_rng(4))
BENCH = SURVEY.bench
N = BLOCKS * ROWS


def test_a_survey_lies_in_its_town():
    assert np.all((SURVEY.x[:, :2] >= 0) & (SURVEY.x[:, :2] <= [EAST, NORTH]))
    assert np.all(np.diff(SURVEY.x[:, 2]) >= 0)
    assert 5 < np.std(SURVEY.prediction) < 25
    assert BENCH.family(BENCH.start)[0, 0, 0] == pytest.approx(SURVEY.deviation**2)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_fault_keeps_a_law_and_does_nothing_at_size_zero(family):
    fault = draw(np.random.default_rng(0), family, SURVEY)
    sound, faulty = fault.change(BENCH.law, 0.0), fault.change(BENCH.law, 0.5)
    np.testing.assert_allclose(sound.mean, BENCH.law.mean, atol=1e-3 * SURVEY.deviation)
    np.testing.assert_allclose(sound.covariance, BENCH.law.covariance, atol=1e-9)
    assert np.linalg.eigvalsh(faulty.covariance).min() > 0
    np.testing.assert_allclose(faulty.covariance, np.swapaxes(faulty.covariance, 1, 2))
    assert information(BENCH, fault.change(BENCH.law, 0.3 * fault.limit)) > 0.1


def test_a_saturated_receiver_shows_no_more_than_its_largest_level():
    fault = draw(np.random.default_rng(0), "saturation", SURVEY)
    assert information(BENCH, fault.change(BENCH.law, 0.0)) < 1e-3
    found = sized(BENCH, fault, 100.0)
    law = fault.change(BENCH.law, found.size)
    drawn = np.stack([measure(np.random.default_rng(k), law) for k in range(400)])
    assert drawn.max() == law.ceiling
    assert found.size == pytest.approx(SURVEY.prediction.max() + 5 * SURVEY.deviation - law.ceiling)
    seen, deviation = shown(law), SURVEY.deviation
    variance = np.einsum("bii->bi", seen.covariance)
    np.testing.assert_allclose(drawn.mean(axis=0), seen.mean, atol=4.5 * deviation / 20)
    np.testing.assert_allclose(drawn.var(axis=0), variance, atol=4.5 * np.sqrt(2) * deviation**2 / 20)
    left = seen.mean - BENCH.law.mean
    expected = N * np.log(np.mean(variance + left**2)) - np.log(variance).sum()
    assert found.lambda_ == pytest.approx(expected, rel=1e-4)


def test_neighbours_that_err_alike_saturate_alike():
    fault = draw(np.random.default_rng(0), "autocorrelated_errors", SURVEY)
    law = replace(fault.change(BENCH.law, 0.5), ceiling=float(np.median(SURVEY.prediction)))
    drawn = np.stack([measure(np.random.default_rng(k), law) for k in range(3000)])
    lag = np.mean(drawn[:, :, 1:] * drawn[:, :, :-1], axis=0) - drawn[:, :, 1:].mean(axis=0) * drawn[
        :, :, :-1
    ].mean(axis=0)
    found = np.diagonal(shown(law).covariance, offset=1, axis1=1, axis2=2)
    assert np.linalg.eigvalsh(shown(law).covariance).min() > 0
    assert found.sum() == pytest.approx(lag.sum(), rel=0.05)


def test_information_of_a_shift_is_the_logarithm_of_the_grown_variance():
    shape = np.random.default_rng(1).standard_normal((BLOCKS, ROWS))
    law = shifted(shape)(BENCH.law, 2.0)
    expected = N * np.log1p(4 * np.mean(shape**2) / SURVEY.deviation**2)
    assert information(BENCH, law) == pytest.approx(expected, rel=1e-4)


def test_information_of_noise_is_the_distance_of_its_means():
    shape = np.random.default_rng(2).uniform(0, 1, (BLOCKS, ROWS))
    law = louder(shape)(BENCH.law, 0.7)
    variance = np.exp(1.4 * shape)
    expected = N * (np.log(variance.mean()) - np.log(variance).mean())
    assert information(BENCH, law) == pytest.approx(expected, rel=1e-4)


def test_information_of_correlated_errors():
    fault = draw(np.random.default_rng(0), "autocorrelated_errors", SURVEY)
    expected = -BLOCKS * (ROWS - 1) * np.log(1 - 0.36)
    assert information(BENCH, fault.change(BENCH.law, 0.6)) == pytest.approx(expected, rel=1e-4)


def test_what_the_twin_can_fit_is_no_information():
    rng = np.random.default_rng(3)
    tangents = rng.standard_normal((5, 8, 2))
    law = Law(np.zeros((5, 8)), np.broadcast_to(np.eye(8), (5, 8, 8)))
    bench = Bench(law, tangents, lambda logs: np.exp(logs[0]) * law.covariance, np.zeros(1))
    imitated = shifted(tangents @ np.array([1.0, -2.0]))(law, 3.0)
    assert information(bench, imitated) < 1e-6
    assert np.abs(visible(bench, imitated)).max() < 1e-9
    other = rng.standard_normal((5, 8))
    matrix, target = tangents.reshape(40, 2), other.reshape(40)
    left = target - matrix @ np.linalg.lstsq(matrix, target, rcond=None)[0]
    found = visible(bench, shifted(other)(law, 1.0))
    np.testing.assert_allclose(found, [*left, *np.zeros(5 * 64)], atol=1e-9)
    found = information(bench, shifted(other)(law, 0.5))
    assert found == pytest.approx(40 * np.log1p(np.mean((0.5 * left) ** 2)), rel=1e-4)


@pytest.mark.parametrize("family", ["label_noise", "regional_bias", "autocorrelated_errors"])
def test_what_can_be_seen_of_a_small_fault_is_its_information(family):
    fault = draw(np.random.default_rng(0), family, SURVEY)
    law = fault.change(BENCH.law, 0.05)
    seen = visible(BENCH, law)
    assert seen @ seen == pytest.approx(information(BENCH, law), rel=0.1)


def test_a_draw_follows_its_law():
    fault = draw(np.random.default_rng(0), "autocorrelated_errors", SURVEY)
    law = fault.change(BENCH.law, 0.6)
    drawn = np.stack([measure(np.random.default_rng(k), law) for k in range(300)]) - law.mean
    lag = np.mean(drawn[:, :, 1:] * drawn[:, :, :-1]) / np.mean(drawn**2)
    assert lag == pytest.approx(0.6, abs=0.01)


def test_a_size_has_the_information_asked_for():
    fault = draw(np.random.default_rng(0), "scale_bias", SURVEY)
    found = sized(BENCH, fault, 60.0)
    assert information(BENCH, fault.change(BENCH.law, found.size)) == pytest.approx(60.0, rel=0.15)


@pytest.mark.study
def test_several_faults_can_be_told_apart():
    families = Families(lambda rng, family: draw(rng, family, SURVEY), LISTED, FOREIGN)
    for seed in range(6):
        found = choose(np.random.default_rng(seed), "triple", BENCH, 50.0, families).faults
        assert len({one.fault.family for one in found}) == 3
        seen = [visible(BENCH, one.fault.change(BENCH.law, one.size)) for one in found]
        for i in range(3):
            for j in range(i):
                assert abs(seen[i] @ seen[j]) <= 0.5 * np.linalg.norm(seen[i]) * np.linalg.norm(seen[j])


def test_cases(tmp_path):
    for name in ("first", "second"):
        TRACK.generate(tmp_path / name, 4, 3, ("null", "listed", "unlisted", "pair"), 100.0)
    files = sorted(path.relative_to(tmp_path / "first") for path in (tmp_path / "first").rglob("*.*"))
    assert [file.read_bytes() for file in (tmp_path / "first" / f for f in files)] == [
        file.read_bytes() for file in (tmp_path / "second" / f for f in files)
    ]
    key = json.loads((tmp_path / "first" / "key.json").read_text())
    assert key["track"] == "labels"
    assert [len(case["effects"]) for case in key["cases"]] == [0, 1, 1, 2]
    for case in key["cases"]:
        folder = tmp_path / "first" / "cases" / case["name"]
        assert load_case(folder / "case.toml").model.name == "label_twin"
        assert read(folder / "labels.csv").labelled.all()
        assert not any(
            one["family"] in (folder / "case.toml").read_text() for one in case["effects"][:1]
        ) or (case["kind"] == "unlisted")


def test_wrong_requests(tmp_path):
    assert set(LISTED) | set(FOREIGN) == set(FAMILIES)
    with pytest.raises(InputError, match="kinds"):
        TRACK.generate(tmp_path, 1, 0, kinds=("quadruple",))
    with pytest.raises(InputError, match="family of faults"):
        draw(np.random.default_rng(0), "weather", SURVEY)
