"""A CASE with a network's log: read, fitted, and a disconnected device named."""

import json

import jax
import numpy as np
import pytest

from dtprob.case import load_case
from dtprob.cli import main
from dtprob.commands.run import Run, infer
from dtprob.data import write
from dtprob.errors import InputError
from dtprob.gap.diagnose import diagnose
from dtprob.gap.settings import Settings
from dtprob.models.declaration import declare
from dtprob.workflow import prepare
from dtprob.workflow.summary import summarise
from tests.small_network import simulate

CASE = """
[model]
name = "multi_access"
[model.options]
clusters = [[0, 1], [2, 3]]
concentration = 0.5
{options}
[data]
file = "after.csv"
reference = "before.csv"
[effects]
use = ["device_disconnected", "arrival_rate_shift", "reception_shift"]
[engine]
name = "{engine}"
[engine.options]
draws = 300
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("network")
    write(folder / "before.csv", simulate(400, 30))
    write(folder / "after.csv", simulate(250, 31, silent=(1,)))
    return folder


def case(folder, engine="laplace", options="window = 10"):
    (folder / "case.toml").write_text(CASE.format(engine=engine, options=options))
    return load_case(folder / "case.toml")


def test_a_fit_says_that_it_does_not_learn_from_the_reference(folder, tmp_path, capsys):
    case(folder, "exact")
    assert main(["fit", str(folder / "case.toml"), "--out", str(tmp_path)]) == 0
    told = "".join(capsys.readouterr())
    assert "fitting after.csv alone: only a diagnosis learns from the reference" in told
    assert "invalid value" not in told


@pytest.mark.study
def test_a_fit_is_summarised(folder):
    prepared = prepare(case(folder, "exact"), need="fit")
    posterior = prepared.engine(prepared.key, prepared.model, prepared.data)
    summary = summarise(posterior)
    json.dumps(summary, allow_nan=False)
    assert summary["warnings"] == []
    arrival = np.exp(posterior.flat("log_arrival")).mean(axis=0)[0, 0]
    np.testing.assert_allclose(arrival, [0.6, 0.0, 0.4, 0.0], atol=0.15)


@pytest.mark.study
def test_a_disconnected_device_is_named(folder):
    prepared = prepare(case(folder), need="diagnosis")
    reference = prepared.engine(jax.random.key(1), prepared.model, prepared.reference)
    found = diagnose(
        prepared.model, prepared.data, prepared.effects, key=prepared.key, engine=prepared.engine,
        reference=reference, settings=Settings(replicates=100, site_replicates=19, candidates=2),
    ).to_report()  # fmt: skip
    assert found["verdict"] == "LISTED"
    assert found["causes"][0]["effects"] == ["device_disconnected[device_1]"]
    assert found["causes"][0]["size"]["loss"]["low"] > 1.0


@pytest.mark.study
def test_of_reference_data_the_unknowns_are_kept_and_nothing_for_each_slot(folder, tmp_path):
    prepared = prepare(case(folder), need="diagnosis")
    run = Run(tmp_path, resume=False, allow_code=False, say=lambda _: None)
    sizes = {
        only: infer(prepared, prepared.reference, tmp_path / f"{only}.nc", run, latents_only=only)
        for only in (True, False)
    }
    assert set(sizes[True].draws) == set(declare(prepared.model, prepared.reference).latent)
    assert set(sizes[False].draws) > set(sizes[True].draws)
    assert (tmp_path / "True.nc").stat().st_size < (tmp_path / "False.nc").stat().st_size / 20


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("trafic = 'markov'", "Did you mean 'traffic'"),
        ("capacity = 2", "no loss below 2 packets"),
        ("window = 'long'", "values of the right type"),
        ("window = 1.5", "values of the right type"),
        ("traffic = 'sometimes'", "expected one of the kinds of traffic"),
    ],
)
def test_options_that_do_not_fit_are_refused(folder, options, message):
    with pytest.raises(InputError, match=message):
        prepare(case(folder, options=options), need="diagnosis")


def test_clusters_are_needed(folder):
    text = CASE.format(engine="exact", options="window = 10").replace("clusters = [[0, 1], [2, 3]]\n", "")
    (folder / "bare.toml").write_text(text)
    with pytest.raises(InputError, match="a key 'clusters'"):
        prepare(load_case(folder / "bare.toml"), need="fit")
