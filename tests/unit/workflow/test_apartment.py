"""The measured apartment from its CASE to a reduced diagnosis; floor plans and readers' options in a CASE."""

from pathlib import Path

import numpy as np
import pytest

from dtprob.case import load_case
from dtprob.data.location import located
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.settings import Settings
from dtprob.workflow import prepare

CASE = Path(__file__).parents[3] / "examples" / "apartment" / "case.toml"
LINKS = [1, 2, 5, 12, 13]


def reduced(folder: Path) -> Path:
    """The example with five links in free sight and a shallow trace."""
    text = CASE.read_text()
    start, end = text.index("use = ["), text.index("[engine]")
    text = text.replace(text[start:end], 'use = ["timing_offset"]\n\n')
    for old, new in (
        ("[data.options]", f"[data.options]\nlinks = {LINKS}"),
        ("max_depth = 4", "max_depth = 1"),
        ("[data]", '[model.options]\nmaterials = "known"\n\n[data]'),
    ):
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "case.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("apartment")
    try:
        located(Path("uwb_apartment"))
    except InputError as error:
        pytest.skip(str(error))
    pytest.importorskip("sionna.rt", exc_type=ImportError)
    return prepare(load_case(reduced(folder)), need="diagnosis", cache=folder)


@pytest.mark.measured
@pytest.mark.libllvm
def test_the_case_binds_data_and_floor_plan(prepared):
    paths = prepared.data["paths"]
    assert prepared.data["channel"].shape == (5, 2, 1, 1, 62)
    np.testing.assert_allclose(np.asarray(paths.rx_position)[:, 2], 1.2)
    flight = np.linalg.norm(paths.rx_position - paths.tx_position, axis=1) / 299_792_458.0
    np.testing.assert_allclose(
        np.asarray(paths.delay).min(axis=1, where=paths.mask, initial=1), flight, rtol=1e-6
    )
    assert {"wall_0", "floor", "ceiling", "wardrobe_0"} <= set(paths.object_names)
    late = np.asarray(prepared.data["rough_delay"])
    assert np.all((late > 0.5e-9) & (late < 3e-9))
    level = 10 * np.log10(np.asarray(prepared.data["link_power"])) + 30
    assert np.all((level > -82) & (level < -78))


@pytest.mark.study
@pytest.mark.measured
@pytest.mark.libllvm
def test_a_reduced_diagnosis_finds_a_gap(prepared):
    settings = Settings(
        replicates=50, site_replicates=19, candidates=1, max_effects=1, folds=2, grid=8, starts=1
    )
    diagnosis = diagnose(
        prepared.model,
        prepared.data,
        prepared.effects[:1],
        key=prepared.key,
        engine=prepared.engine,
        settings=settings,
    )
    report = diagnosis.to_report()
    assert report["verdict"] != "NO_GAP"
    before = report["gap"]["in_user_terms"]["channel_nmse_db"][0]
    assert -15 < before < 3


PLAN = """{"walls_xyxy": [[0, 0, 8, 0], [8, 0, 8, 5], [8, 5, 0, 5], [0, 5, 0, 0], [4, 0, 4, 5]]}"""
CHECKED = """
[model]
name = "ray_traced_channel"
[data]
file = "channels.npz"
[scene]
file = "plan.json"
frequency = 4e9
max_depth = 1
ceiling_height = 3.0
merge_shapes = false
skip_unreached = true
strongest = 4
check_depth = 2
check_refraction = true
check_transmitters = true
[effects]
use = ["depth_cut_off", "refraction_off", "swapped_transmitters"]
"""


@pytest.mark.study
@pytest.mark.libllvm
def test_what_the_tracer_leaves_out_becomes_candidates(tmp_path):
    pytest.importorskip("sionna.rt", exc_type=ImportError)
    (tmp_path / "plan.json").write_text(PLAN)
    (tmp_path / "case.toml").write_text(CHECKED)
    tx = np.array([[1.0, 1.0, 1.5], [1.0, 1.0, 1.5], [2.0, 4.0, 1.5], [2.0, 4.0, 1.5]])
    rx = np.array([[3.0, 2.0, 1.2], [2.0, 4.0, 1.5], [3.0, 2.0, 1.2], [7.0, 3.0, 1.2]])
    frequency = 1e6 * np.arange(4)
    np.savez(
        tmp_path / "channels.npz",
        channel=np.ones((4, 1, 1, 1, 4), complex),
        subcarrier_frequency=frequency,
        tx_position=tx,
        rx_position=rx,
    )
    found = prepare(load_case(tmp_path / "case.toml"), need="diagnosis")
    paths = found.data["paths"]
    assert paths.beyond_names == ("depth", "refraction", "transmitter_0", "transmitter_1")
    assert [e.name for e in found.effects] == [
        *("depth_cut_off", "refraction_off", "swapped_transmitters[0_1]"),
    ]
    assert np.asarray(paths.mask).sum(axis=1).tolist() == [4, 4, 4]  # behind the wall nothing arrives
    code, step = np.asarray(paths.beyond), np.asarray(paths.interaction)
    assert np.all((step[code == 1] != 0).sum(axis=-1) == 2)
    assert np.all((step[code == 2] == 4).any(axis=-1))
    # a link's own transmitter brings nothing new, and the second link's receiver stands where the second transmitter does
    assert (code == 3).sum(axis=1).tolist() == [0, 0, 4]
    assert (code == 4).sum(axis=1).tolist() == [4, 0, 0]


def test_readers_options_are_checked(tmp_path):
    from dtprob.data import read

    (tmp_path / "a.csv").write_text("x,y\n1,2\n")
    with pytest.raises(InputError, match=r"options of a.csv: expected none, got averages"):
        read(tmp_path / "a.csv", {"averages": 2})


def test_a_measured_set_that_is_not_there(monkeypatch, tmp_path):
    monkeypatch.setenv("DTPROB_DATA", str(tmp_path))
    with pytest.raises(InputError, match="Set DTPROB_DATA"):
        prepare(load_case(CASE), need="fit")
    assert located(tmp_path / "other.npz") == tmp_path / "other.npz"
