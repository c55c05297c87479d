"""Withheld cases: what is in them, and that a seed makes them again, byte for byte."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.physical.campaign import Plan, Site, make_site
from dtprob.physical.cases import TRACK, track
from dtprob.physical.choose import APART, FOREIGN, LISTED, choose, correlation
from dtprob.physical.draws import FAMILIES
from dtprob.physical.front_end import carrier_phase, gain_offset

PLAN = Plan(links=4, subcarriers=8, rx_shape=(1, 2), tx_shape=(1, 1), max_depth=2, rays=20_000)
FAST = ("timing_offset", "gain_offset", "phase_error", "interference")


@pytest.fixture
def site(bench, setting) -> Site:
    return Site(None, bench.world, setting, bench, bench.noise_power, None)


def pick(kind, site, target=50.0, families=LISTED, seed=0):
    return choose(np.random.default_rng(seed), kind, site, target, families)


def test_every_family_is_listed_or_foreign():
    assert set(LISTED) | set(FOREIGN) == set(FAMILIES)
    assert not set(LISTED) & set(FOREIGN)


def test_a_null_case_has_nothing(site):
    assert pick("null", site).effects == ()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("kind", "count"), [("listed", 1), ("pair", 2), ("triple", 3)])
def test_effects_carry_the_information_asked_for(kind, count, seed, site):
    found = pick(kind, site, seed=seed)
    assert len({one.impairment.family for one in found.effects}) == count
    for one in found.effects:
        assert one.lambda_ == pytest.approx(50, rel=0.15)
        assert site.bench.information(one.impairment, one.size) == pytest.approx(one.lambda_)
    assert found.excluded == ()


def test_effects_of_one_case_can_be_told_apart(site):
    for seed in range(6):
        first, second = pick("pair", site, seed=seed).effects
        if first.impairment.noise or second.impairment.noise:
            continue
        if first.impairment.spread or second.impairment.spread:
            continue
        seen = [site.bench.visible(one.impairment, one.size) for one in (first, second)]
        assert abs(correlation(*seen)) < APART


def test_unlisted_cases_take_the_family_out_or_have_a_foreign_one(site):
    kinds = set()
    for seed in range(12):
        found = pick("unlisted", site, seed=seed)
        family = found.effects[0].impairment.family
        kinds.add(family in FOREIGN)
        assert found.excluded == (() if family in FOREIGN else (family,))
    assert kinds == {True, False}


def test_an_alias_looks_like_its_effect(site):
    families = ("carrier_frequency_offset", "doppler", "gain_offset", "timing_offset")
    found = pick("alias", site, families=families)
    assert found.alias is not None
    name, similar = found.alias
    assert similar > 0.5
    assert name != found.effects[0].impairment.name


def test_what_cannot_be_told_says_so(site):
    with pytest.raises(InputError, match="lambda 1e"):
        pick("listed", site, target=1e12, families=("gain_offset",))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"kinds": ("nul",)}, "null"),
        ({"families": ("timing_ofset",)}, "timing_offset"),
        ({"lambda_": -1.0}, "positive"),
        ({"kinds": ()}, "kinds"),
    ],
)
def test_wrong_requests_are_refused(arguments, text, tmp_path):
    with pytest.raises(InputError, match=text):
        TRACK.generate(tmp_path, 1, 0, **arguments)


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.study
@pytest.mark.libllvm
def test_the_same_seed_makes_the_same_bytes_and_resumes(tmp_path):
    def make(name: str, **changes):
        return track(PLAN).generate(
            tmp_path / name,
            4,
            5,
            ("null", "listed", "pair", "unlisted"),
            60.0,
            families=FAST,
            **changes,
        )

    seen = []
    key = make("a", progress=lambda done, count: seen.append((done, count)))
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    make("b")
    first = content(tmp_path / "a")
    assert first == content(tmp_path / "b")
    (tmp_path / "b" / "truth" / "0002.json").unlink()
    (tmp_path / "b" / "key.json").unlink()
    make("b", resume=True)
    assert first == content(tmp_path / "b")
    check_key(tmp_path / "a", json.loads(key.read_text()))


def check_key(folder: Path, key: dict) -> None:
    assert [case["kind"] for case in key["cases"]] == ["null", "listed", "pair", "unlisted"]
    for case in key["cases"]:
        lies = folder / "cases" / case["name"]
        assert {p.name for p in lies.iterdir()} == {"case.toml", "channels.npz", "paths.nc"}
        text = (lies / "case.toml").read_text()
        assert all(f'"{name}"' in text for name in case["excluded"])
        with np.load(lies / "channels.npz") as data, np.load(folder / case["truth"]) as truth:
            residual = data["channel"] - truth["noiseless"]
            assert np.mean(np.abs(residual) ** 2) == pytest.approx(case["noise_power"], rel=0.2)
            changed = np.any(truth["noiseless"] != truth["base"])
        mean_effects = [e for e in case["effects"] if e["family"] not in ("interference", "correlated_noise")]
        assert changed == bool(mean_effects)
        assert b"lambda" not in (lies / "case.toml").read_bytes()


@pytest.mark.libllvm
def test_a_prior_on_phases_bounds_what_a_common_phase_tells():
    site = make_site(np.random.default_rng(0), replace(PLAN, model="phase_error_channel"))
    assert site.concentration is not None
    phases = site.setting.rays.mask.sum() * PLAN.snapshots
    found = site.bench.information(carrier_phase(), 0.1)
    assert 0.2 * 0.01 * site.concentration * phases < found <= 1.01 * 0.01 * site.concentration * phases


@pytest.mark.libllvm
def test_packets_of_unknown_phase_hide_a_common_phase():
    site = make_site(np.random.default_rng(0), replace(PLAN, phase="per_packet"))
    assert site.bench.information(carrier_phase(), 0.01) < 1e-3
    assert site.bench.information(gain_offset(), 0.1) > 1e-1
