"""Campaigns of users' own models with faults: laws, information, the models beside the data, the same bytes again."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers

from dtprob.case import load_case
from dtprob.errors import InputError
from dtprob.physical import custom_fading as fading
from dtprob.physical import custom_path_loss as path_loss
from dtprob.physical.custom_cases import FAMILIES, FOREIGN, LISTED, TRACK
from dtprob.physical.gaussian import information, visible
from dtprob.usercode import load_object
from dtprob.workflow import prepare

STREETS = path_loss.make_streets(np.random.default_rng(0))
RUNS = fading.make_runs(np.random.default_rng(0))
KINDS = [(path_loss, STREETS, name) for name in path_loss.FAMILIES]
KINDS += [(fading, RUNS, name) for name in fading.FAMILIES]


@pytest.mark.parametrize(("track", "made", "family"), KINDS)
def test_every_fault_keeps_a_law_and_does_nothing_at_size_zero(track, made, family):
    bench = made.bench
    fault = track.draw(np.random.default_rng(0), family, made)
    sound, faulty = fault.change(bench.law, 0.0), fault.change(bench.law, 0.6)
    np.testing.assert_allclose(sound.mean, bench.law.mean, atol=1e-9)
    np.testing.assert_allclose(sound.covariance, bench.law.covariance, atol=1e-9)
    assert np.linalg.eigvalsh(faulty.covariance).min() > 0
    assert information(bench, fault.change(bench.law, 0.3 * fault.limit)) > 1.0


def test_bursts_are_anywhere_in_a_run():
    hit = np.zeros(fading.STEPS, bool)
    for seed in range(20):
        fault = fading.draw(np.random.default_rng(seed), "bursts", RUNS)
        hit |= np.any(fault.change(RUNS.bench.law, 1.0).mean != RUNS.bench.law.mean, axis=0)
    assert hit.all()


@pytest.mark.parametrize("order", [("deeper_fading", "speed_change"), ("speed_change", "deeper_fading")])
def test_fading_that_is_deeper_and_faster_is_both(order):
    law = RUNS.bench.law
    for family in ("own_level", *order, "gain_drift"):
        law = fading.draw(np.random.default_rng(0), family, RUNS).change(law, 2.0)
    late = 0.5 * (1 + np.tanh((np.linspace(0, 1, fading.STEPS) - 0.5) / 0.02))
    both = RUNS.faded(RUNS.fading * (1 + 2 * late), np.cumsum(1 + 2 * late))
    np.testing.assert_allclose(law.covariance, both + 4.0)


def test_sound_laws_are_what_the_twins_can_fit():
    for bench in (STREETS.bench, RUNS.bench):
        np.testing.assert_allclose(bench.family(bench.start), bench.law.covariance, rtol=1e-9)
        assert information(bench, bench.law) < 1e-6
        assert np.abs(visible(bench, bench.law)).max() < 1e-9


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("custom")
    TRACK.generate(folder, 9, 3, ("null",), 100.0)
    return folder


def case(folder, name):
    return prepare(load_case(folder / "cases" / name / "case.toml"), need="diagnosis")


def log_density(prepared, values):
    """Log density of the observed power at values of the latent sites."""
    model = handlers.substitute(handlers.seed(prepared.model, jax.random.key(0)), data=values)
    site = handlers.trace(model).get_trace(**prepared.data)["power"]
    return float(jnp.sum(site["fn"].log_prob(site["value"])))


def test_the_filter_gives_the_density_of_the_whole_run(folder):
    prepared = case(folder, "0008")
    truth = json.loads((folder / "truth" / "0008.json").read_text())
    made = fading.make_runs(np.random.default_rng([3, 1, 0]))
    np.testing.assert_allclose(prepared.data["distance"], made.distance)
    law = made.bench.law
    left = np.asarray(prepared.data["power"]) - law.mean
    expected = -0.5 * sum(
        x @ np.linalg.solve(c, x) + np.linalg.slogdet(2 * np.pi * c)[1]
        for x, c in zip(left, law.covariance, strict=True)
    )
    values = {"level": truth["level"], "exponent": truth["exponent"], "correlation": truth["correlation"]}
    values |= {"fading_deviation": truth["fading"], "noise_deviation": truth["noise"]}
    found = log_density(prepared, {name: jnp.asarray(v) for name, v in values.items()})
    assert found == pytest.approx(expected, rel=1e-5)


def test_the_state_space_model_draws_what_its_filter_expects(folder):
    model = load_object("slow_fading:slow_fading", folder / "cases" / "0008")
    values = {
        "level": 0.0,
        "exponent": 0.0,
        "correlation": 0.8,
        "fading_deviation": 4.0,
        "noise_deviation": 1.5,
    }
    fixed = handlers.substitute(model, data={name: jnp.asarray(v) for name, v in values.items()})
    drawn = handlers.trace(handlers.seed(fixed, jax.random.key(0))).get_trace(distance=jnp.ones((4000, 6)))
    power = np.asarray(drawn["power"]["value"])
    lag = np.abs(np.subtract.outer(np.arange(6), np.arange(6)))
    expected = 16 * 0.8**lag + 2.25 * np.eye(6)
    # 4,000 draws: the largest of 36 entries strays by less than 4 deviations of 18.25 * sqrt(2 / 4000).
    np.testing.assert_allclose(np.cov(power.T), expected, atol=4 * 18.25 * np.sqrt(2 / 4000))


def test_cases_prepare_with_their_effects(folder):
    left_out = {
        one["name"]: set(one["excluded"]) for one in json.loads((folder / "key.json").read_text())["cases"]
    }
    streets = case(folder, "0000")
    assert streets.cluster == "segment"
    known = set(LISTED) & set(path_loss.FAMILIES)
    assert {effect.family for effect in streets.effects} == known - left_out["0000"]
    runs = case(folder, "0008")
    known = set(LISTED) & set(fading.FAMILIES)
    assert {effect.family for effect in runs.effects} == known - left_out["0008"]
    for prepared in (streets, runs):
        assert prepared.case.user_code


def test_the_same_bytes_again(folder, tmp_path):
    TRACK.generate(tmp_path, 1, 3, ("null",), 100.0)
    files = sorted(path.relative_to(tmp_path) for path in (tmp_path / "cases").rglob("*.*"))
    assert len(files) == 4
    assert all((tmp_path / file).read_bytes() == (folder / file).read_bytes() for file in files)


def test_campaigns_are_of_a_kind_that_has_the_families(tmp_path):
    for family, model in (("handover", "slow_fading"), ("wall", "path_loss")):
        key = TRACK.generate(tmp_path / family, 9, 1, ("listed",), 60.0, families=(family,))
        for case_ in json.loads(key.read_text())["cases"]:
            assert case_["model"] == model
            assert case_["effects"][0]["family"] == family
    with pytest.raises(InputError, match="Name more families"):
        TRACK.generate(tmp_path / "three", 1, 1, ("triple",), 60.0, families=fading.FAMILIES[1:3])


def test_wrong_requests(tmp_path):
    assert set(LISTED) | set(FOREIGN) == set(FAMILIES)
    with pytest.raises(InputError, match="families"):
        TRACK.generate(tmp_path, 1, 0, families=("weather",))
    for track, made in ((path_loss, STREETS), (fading, RUNS)):
        with pytest.raises(InputError, match="family of faults"):
            track.draw(np.random.default_rng(0), "weather", made)
