"""Columns of words: numbers by the lists of the CASE, and words again in what is reported."""

import json
import re
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from dtprob.case import Case, load_case
from dtprob.commands.diagnose import run
from dtprob.errors import InputError
from dtprob.workflow import prepare
from dtprob.workflow.words import coded, spelled

MODEL = """import numpyro
import numpyro.distributions as dist


def street(distance, site, level=None):
    with numpyro.plate("sites", 3):
        own = numpyro.sample("own", dist.Normal(0.0, 5.0))
    slope = numpyro.sample("slope", dist.Normal(-0.1, 0.1))
    start = numpyro.sample("start", dist.Normal(-60.0, 10.0))
    mean = numpyro.deterministic("mean", start + own[site] + slope * distance)
    with numpyro.plate("row", len(distance)):
        numpyro.sample("level", dist.Normal(mean, 2.0), obs=level)
"""
CASE = """[model]
name = "street_of_words:street"
[engine]
name = "laplace"
[seed]
value = 0
[data]
file = "t.csv"
{more}
"""
SITES = ("harbour", "station", "tower")
WORDS = '[data.words]\nsite = ["harbour", "station", "tower"]'
ROWS = "\n".join(f"{10.0 + i},{SITES[i % 3]},{-60.0 - i % 7}" for i in range(30))


def case(folder: Path, rows: str, more: str = "") -> Case:
    (folder / "street_of_words.py").write_text(MODEL)
    (folder / "t.csv").write_text(f"distance,site,level\n{rows}\n")
    (folder / "case.toml").write_text(CASE.format(more=more))
    return load_case(folder / "case.toml")


def test_each_word_is_its_place_in_the_list(tmp_path):
    prepared = prepare(case(tmp_path, rows=ROWS, more=WORDS), need="fit")
    assert jnp.issubdtype(prepared.data["site"].dtype, jnp.integer)
    assert_array_equal(prepared.data["site"], np.arange(30) % 3)


def test_the_order_is_that_of_the_list(tmp_path):
    other = '[data.words]\nsite = ["tower", "station", "harbour"]'
    assert_array_equal(prepare(case(tmp_path, rows=ROWS, more=other), need="fit").data["site"][:3], [2, 1, 0])


def test_an_earlier_table_has_the_same_numbers(tmp_path):
    fewer = "\n".join(f"{10.0 + i},{SITES[1 + i % 2]},{-60.0 - i % 7}" for i in range(20))
    (tmp_path / "before.csv").write_text(f"distance,site,level\n{fewer}\n")
    found = prepare(
        case(tmp_path, rows=ROWS, more=f'reference = "before.csv"\n{WORDS}\n[effects]\nuse = []'),
        need="diagnosis",
    )
    assert found.reference is not None
    assert_array_equal(found.reference["site"][:2], [1, 2])


@pytest.mark.parametrize(
    ("rows", "more", "told"),
    [
        (
            ROWS,
            "",
            r'column \'site\': expected numbers.*\[data.words\] site = \["harbour", "station", "tower"\]',
        ),
        (
            ROWS.replace("tower", "towr", 1),
            WORDS,
            r"column 'site', row 2: expected one of .* Did you mean 'tower'",
        ),
        (ROWS.replace("tower", "quay", 1), WORDS, r"got 'quay'.*add it to site in \[data.words\]"),
        (ROWS, WORDS.replace("station", "tower"), r"\[data.words\] site: .*'tower' twice"),
        (ROWS, WORDS.replace("site", "sight"), r"\[data.words\].*'sight'.*Did you mean 'site'"),
        (ROWS, WORDS.replace("site", "distance"), r"column 'distance': expected words, got numbers"),
        (ROWS, "[data.words]\nsite = 3", r"words: expected a table of lists of words"),
    ],
)
def test_what_is_wrong_is_said_with_what_to_do(tmp_path, rows, more, told):
    with pytest.raises(InputError) as caught:
        prepare(case(tmp_path, rows=rows, more=more), need="fit")
    assert re.search(told, str(caught.value)), str(caught.value)


def test_words_may_lie_in_several_dimensions():
    """As an NPZ file can hold them."""
    table, file = {"site": np.array([["harbour", "tower"], ["tower", "quay"]])}, Path("t.npz")
    listed = {"site": (*SITES, "quay")}
    assert_array_equal(coded(file, table, listed, ["site"])["site"], [[0, 2], [2, 3]])
    with pytest.raises(InputError, match=r"column 'site', row 1, 1: expected one of .*, got 'quay'"):
        coded(file, table, {"site": SITES}, ["site"])
    with pytest.raises(InputError, match=r'first.*Number its words .* site = ."harbour", "quay", "tower"'):
        coded(file, table, {}, ["site"])


def test_a_single_word_is_no_list_of_letters():
    table, file = {"season": np.array("dry")}, Path("t.npz")
    assert coded(file, table, {"season": ("wet", "dry")}, ["season"])["season"] == 1
    assert coded(file, table, {}, ["season"])["season"] == "dry"


def test_names_may_begin_with_a_digit(tmp_path):
    bands = "\n".join(f"{10.0 + i},{('2.4GHz', '5GHz')[i % 2]},{-60.0 - i % 7}" for i in range(30))
    with pytest.raises(InputError, match=r'\[data.words\] site = \["2.4GHz", "5GHz"\]'):
        prepare(case(tmp_path, rows=bands), need="fit")


def test_data_that_are_no_table_have_no_columns_of_words(tmp_path):
    told = case(tmp_path, rows=ROWS, more=WORDS)
    example = Path(__file__).parents[3] / "examples" / "labels"
    table = replace(told.data, file=example / "rssi.csv")
    with pytest.raises(InputError, match=r"\[data.words\]: expected no columns, got 'site'"):
        prepare(replace(told, model=load_case(example / "case.toml").model, data=table), need="fit")


def test_times_and_odd_cells_are_not_taken_for_names(tmp_path):
    stamped = "\n".join(f"{10.0 + i},2026-01-{1 + i % 3:02d},{-60.0 - i % 7}" for i in range(30))
    with pytest.raises(InputError, match="each time seconds"):
        prepare(case(tmp_path, rows=stamped), need="fit")


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("site 1", "site station"),
        ("site 1, hour 18 to 21", "site station, hour 18 to 21"),
        ("site 0 to 1", "site 0 to 1"),
        ("site 0.5", "site 0.5"),
        ("campsite 1", "campsite 1"),
        ("site 3", "site 3"),
        ("site 11", "site 11"),
        ("row 1", "row 1"),
    ],
)
def test_places_are_called_by_their_words(place, said):
    sites = [{"site": "mean", "place": place}, {"site": "level"}]
    report = {
        "where": {"sites": sites},
        "unlisted": {"located": sites},
        "summary": f"A gap at mean; most of it at {place}.",
    }
    found, named = spelled(report, {"site": SITES}), [{"site": "mean", "place": said}, {"site": "level"}]
    assert found["where"]["sites"] == found["unlisted"]["located"] == named
    assert found["summary"] == f"A gap at mean; most of it at {said}."


def test_so_are_ways_to_vary():
    report = {
        "where": {
            "sites": [{"family": "spread, site 2, distance 3 to 5", "whereabouts": "site 2, distance 3 to 5"}]
        }
    }
    report["remainder"] = {"terms": [{"shape": "additive, along distance by site", "weights": 3}]}
    found = spelled(report, {"site": SITES})
    assert found["where"]["sites"] == [
        {"family": "spread, site tower, distance 3 to 5", "whereabouts": "site tower, distance 3 to 5"}
    ]
    assert found["remainder"] == report["remainder"]
    assert spelled({**report, "remainder": None}, {"site": SITES})["remainder"] is None


def test_a_diagnosis_speaks_of_words(tmp_path):
    random = np.random.default_rng(0)
    rows = "\n".join(
        f"{d:.1f},{SITES[i % 3]},{-60.0 - 0.1 * d - 9.0 * (i % 3 == 2) * (d > 30) + 2.0 * random.standard_normal():.3f}"
        for i, d in enumerate(random.uniform(10, 60, 240))
    )
    told = case(tmp_path, rows=rows, more=WORDS + "\n[effects]\nuse = []")
    out = tmp_path / "out"
    run(told, out, engine=None, seed=None, no_code=False, resume=False)
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == "UNLISTED"
    assert report["provenance"]["words"] == {"site": list(SITES)}
    told = [site.get(key, "") for site in report["where"]["sites"] for key in ("place", "whereabouts")]
    assert any("site tower" in words for words in told)
    assert not any("site 2" in words for words in told)
    page = (out / "report.html").read_text()
    assert "site tower" in page
    assert page.count("harbour") > 1  # the places of the picture along the column


@pytest.mark.parametrize("cells", [('"-71,5"', '"-70,5"'), ('"1,100"', '"1,200"')])
def test_numbers_with_commas_are_no_words(tmp_path, cells):
    rows = "\n".join(f"{10.0 + i},{SITES[i % 3]},{cells[i % 2]}" for i in range(30))
    with pytest.raises(InputError, match=r"got words \('.*' first\)\. Write points in numbers"):
        prepare(case(tmp_path, rows, WORDS), need="fit")
