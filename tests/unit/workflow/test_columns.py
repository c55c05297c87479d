"""What a table lacks for a model of the user's own is said with what it has."""

import numpy as np
import pytest

from dtprob.case import load_case
from dtprob.errors import InputError
from dtprob.workflow import prepare

MODEL = """import numpyro
import numpyro.distributions as dist


def street(distance, site, level=None, *, sites=3):
    with numpyro.plate("sites", sites):
        own = numpyro.sample("own", dist.Normal(0.0, 5.0))
    slope = numpyro.sample("slope", dist.Normal(-0.1, 0.1))
    with numpyro.plate("row", len(distance)):
        mean = numpyro.deterministic("mean", own[site] + slope * distance)
        numpyro.sample("level", dist.Normal(mean, 2.0), obs=level)
"""
CASE = """[model]
name = "street_of_columns:street"
[data]
file = "t.csv"
{more}
[engine]
name = "laplace"
[seed]
value = 0
"""
ROWS = "\n".join(f"{10.0 + i},{i % 3},{-60.0 - i % 7}" for i in range(30))


def case(folder, header="distance,site,level", rows=ROWS, more=""):
    (folder / "street_of_columns.py").write_text(MODEL)
    (folder / "t.csv").write_text(f"{header}\n{rows}\n")
    (folder / "case.toml").write_text(CASE.format(more=more))
    return load_case(folder / "case.toml")


def test_a_whole_table_is_taken(tmp_path):
    found = prepare(case(tmp_path), need="diagnosis").data
    assert np.asarray(found["site"]).tolist() == [i % 3 for i in range(30)]


def test_a_missing_column_is_named_with_those_that_are_there(tmp_path):
    message = r"t\.csv: expected a column 'distance', got distance \(m\), site, level\. Rename 'distance \(m\)' there"
    with pytest.raises(InputError, match=message):
        prepare(case(tmp_path, header="distance (m),site,level"), need="diagnosis")


@pytest.mark.parametrize("spelt", ["Level", "LEVEL", "level (dBm)", "level [dBm]"])
def test_what_is_observed_may_be_left_out_but_not_spelt_otherwise(tmp_path, spelt):
    """The model runs without it, and would be told that it observes nothing."""
    with pytest.raises(InputError, match=r"t\.csv: expected a column 'level', got '.*'\. Rename '.*' there"):
        prepare(case(tmp_path, header=f"distance,site,{spelt}"), need="diagnosis")
    with pytest.raises(InputError, match="model street: expected an observed site"):
        prepare(case(tmp_path, header="distance,site,other"), need="diagnosis")


def test_an_index_beyond_the_end_is_told_with_the_table(tmp_path):
    with pytest.raises(InputError, match=r"t\.csv, column 'site': expected indices from 0 to 2 .* got 3\."):
        prepare(case(tmp_path, rows=ROWS + "\n12.0,3,-61.0"), need="fit")


def test_an_array_without_a_value_is_named(tmp_path):
    made = case(tmp_path)
    none = {"distance": np.zeros(0), "site": np.zeros(0, int), "level": np.zeros(0)}
    np.savez(tmp_path / "t.npz", **none)
    (tmp_path / "case.toml").write_text(CASE.format(more="").replace("t.csv", "t.npz"))
    with pytest.raises(InputError, match=r"t\.npz, column 'distance': expected a value or more, got none"):
        prepare(load_case(made.path), need="fit")


def test_designs_need_no_observed_column(tmp_path):
    (tmp_path / "elsewhere.csv").write_text("distance,site\n20.0,0\n30.0,1\n")
    found = prepare(case(tmp_path, more='designs = "elsewhere.csv"'), need="diagnosis").designs
    assert list(found) == ["elsewhere"]
