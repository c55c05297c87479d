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
