"""A user's own model on a user's own table: the example names the site, street by street."""

import runpy
import shutil
import sys
from pathlib import Path

import pytest

from dtprob.case import load_case
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.settings import Settings
from dtprob.workflow import prepare

EXAMPLE = Path(__file__).parents[3] / "examples" / "path_loss"


@pytest.fixture
def folder(tmp_path):
    for file in EXAMPLE.glob("*.*"):
        shutil.copy(file, tmp_path)
    return tmp_path


def test_the_table_is_what_its_script_writes(folder, monkeypatch):
    before = (folder / "table.csv").read_bytes()
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "path_loss", raising=False)  # of another case
    runpy.run_path(str(folder / "make_table.py"), run_name="__main__")
    assert (folder / "table.csv").read_bytes() == before


@pytest.mark.study
def test_the_site_that_sends_less_is_named(folder):
    prepared = prepare(load_case(folder / "case.toml"), need="diagnosis")
    assert prepared.cluster == "segment"
    found = diagnose(
        prepared.model, prepared.data, prepared.effects, key=prepared.key, engine=prepared.engine,
        cluster=prepared.cluster, settings=Settings(replicates=100, site_replicates=39, candidates=2, polished=1),
    )  # fmt: skip
    assert found.verdict == "LISTED"
    assert found.causes[0].effects == ("site_gain[harbour]",)
    size = found.causes[0].size[0]
    assert size.low < -5.0 < size.high
    assert found.to_report()["fit"]["n_clusters"] == 30
    assert found.maps["clusters"].sizes["segment"] == 30


def test_a_family_of_the_users_own_can_be_left_out(folder):
    case = folder / "case.toml"
    case.write_text(case.read_text().replace("[effects]", '[effects]\nexclude = ["site_gain"]'))
    families = {effect.family for effect in prepare(load_case(case), need="diagnosis").effects}
    assert families
    assert "site_gain" not in families


def test_code_of_the_users_own_can_be_refused(folder):
    with pytest.raises(InputError, match="a model and effects of dtprob"):
        prepare(load_case(folder / "case.toml"), need="diagnosis", allow_code=False)


def test_measurements_that_could_be_made_are_read_like_the_data(folder):
    shutil.copy(folder / "table.csv", folder / "elsewhere.csv")
    case = (folder / "case.toml").read_text().replace("[effects]", 'designs = "elsewhere.csv"\n\n[effects]')
    (folder / "case.toml").write_text(case)
    prepared = prepare(load_case(folder / "case.toml"), need="diagnosis")
    assert list(prepared.designs) == ["elsewhere"]
    assert set(prepared.designs["elsewhere"]) == set(prepared.data)
    assert prepare(load_case(folder / "case.toml"), need="fit").designs == {}
