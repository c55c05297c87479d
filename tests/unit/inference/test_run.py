"""The run loop: chunks, interruptions and the number of chains never change a draw; angles mix."""

import json

import jax
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.errors import InputError
from dtprob.inference import HMC, NUTS, BlackJAXNUTS, RunOptions, checkpoint, summary
from dtprob.inference import run as run_module
from dtprob.inference.build import build_target
from dtprob.inference.enough import Enough
from dtprob.inference.identity import identity
from tests.unit.inference.examples import (
    at_the_cut,
    at_the_cut_data,
    logistic,
    logistic_data,
    normal,
    normal_data,
    normal_posterior,
)

KEY = jax.random.key(21)
ENGINES = [NUTS, BlackJAXNUTS, HMC]
SHORT = {"warmup": 60, "draws": 50, "chains": 2}


def same(first, second):
    return all(np.array_equal(first.draws[name], second.draws[name]) for name in first.draws) and all(
        np.array_equal(first.sample_stats[name], second.sample_stats[name]) for name in first.sample_stats
    )


@pytest.mark.parametrize("engine", ENGINES)
def test_conjugate_normal(engine):
    data = normal_data()
    mean, spread, _ = normal_posterior(data)
    table = summary(engine(draws=1000, warmup=300)(KEY, normal, data))
    row = table.loc["level"]
    assert abs(row["mean"] - mean) < 4 * spread / row["ess"] ** 0.5
    assert row["sd"] == pytest.approx(spread, rel=0.1)
    assert row["rhat"] < 1.01


@pytest.mark.parametrize("engine", ENGINES)
def test_chunks_chains_and_draws_do_not_change_a_draw(engine):
    data = logistic_data()
    whole = engine(**SHORT)(KEY, logistic, data)
    for chunk in (7, 60):
        assert same(whole, engine(**SHORT)(KEY, logistic, data, options=RunOptions(chunk=chunk)))
    one = engine(warmup=60, draws=50, chains=1)(KEY, logistic, data)
    np.testing.assert_array_equal(one.draws["weight"][0], whole.draws["weight"][0])
    for draws in (1, 33, 70, 130):
        other = engine(warmup=60, draws=draws, chains=2)(KEY, logistic, data)
        shared = min(draws, 50)
        for name, values in whole.draws.items():
            np.testing.assert_array_equal(other.draws[name][:, :shared], values[:, :shared])


@pytest.mark.study
def test_side_by_side_is_the_same_up_to_rounding_at_first():
    data = normal_data()
    apart = NUTS(warmup=0, draws=5, chains=3)(KEY, normal, data)
    together = NUTS(warmup=0, draws=5, chains=3, chain_method="vectorized")(KEY, normal, data)
    np.testing.assert_allclose(together.draws["level"], apart.draws["level"], rtol=1e-6)


@pytest.mark.parametrize(
    "engine", [NUTS, *(pytest.param(kind, marks=pytest.mark.study) for kind in (BlackJAXNUTS, HMC))]
)
def test_an_angle_at_the_cut_mixes(engine):
    data = at_the_cut_data()
    posterior = engine(draws=700, warmup=500)(KEY, at_the_cut, data)
    table = summary(posterior)
    assert table["rhat"].max() < 1.02
    assert table["ess"].min() > 300
    eta = 3.0 * np.exp(1j * data["y"]).sum() + 0.05
    error = np.angle(np.exp(1j * (table.loc["angle", "mean"] - np.angle(eta))))
    assert abs(error) < 4 * np.abs(eta) ** -0.5 / table.loc["angle", "ess"] ** 0.5
    assert table.loc["angle", "resultant_length"] == pytest.approx(1 - 0.5 / np.abs(eta), abs=0.01)
    assert table.loc["angle", "low"] > table.loc["angle", "high"]  # the interval crosses the cut
    assert table.loc["free", "resultant_length"] < 0.1
    assert not posterior.sample_stats["diverging"].any()
    assert posterior.sample_stats["tree_depth"].max() <= 6  # flat directions do not run on for ever


class StoppedError(Exception):
    pass


def stop_after(monkeypatch, chunks):
    """Let the run fail once so many checkpoints are written, one after each chunk."""
    write = checkpoint.write
    written = []

    def writing(*arguments):
        write(*arguments)
        written.append(1)
        if len(written) == chunks:
            raise StoppedError

    monkeypatch.setattr(checkpoint, "write", writing)
    monkeypatch.setattr(checkpoint, "SAVE_EVERY", 0.0)
    monkeypatch.setattr(checkpoint, "_SAVE_SHARE", 0.0)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("chunks", [2, *(pytest.param(chunks, marks=pytest.mark.study) for chunks in (1, 5))])
def test_an_interrupted_run_continues_as_if_nothing_had_happened(engine, chunks, tmp_path, monkeypatch):
    data = at_the_cut_data()
    whole = engine(**SHORT)(KEY, at_the_cut, data)
    options = RunOptions(checkpoint=tmp_path / "run.h5", chunk=20, resume=True)
    with monkeypatch.context() as patch:
        stop_after(patch, chunks)
        with pytest.raises(StoppedError):
            engine(**SHORT)(KEY, at_the_cut, data, options=options)
    assert same(whole, engine(**SHORT)(KEY, at_the_cut, data, options=options))
    assert same(whole, engine(**SHORT)(KEY, at_the_cut, data, options=options))  # nothing left to do


def test_a_checkpoint_of_another_run_is_refused(tmp_path):
    options = RunOptions(checkpoint=tmp_path / "run.h5", chunk=50, resume=True)
    NUTS(**SHORT)(KEY, normal, normal_data(), options=options)
    attempts = {
        "data_sha256": lambda: NUTS(**SHORT)(KEY, normal, normal_data(1), options=options),
        "key": lambda: NUTS(**SHORT)(jax.random.key(1), normal, normal_data(), options=options),
        "settings": lambda: NUTS(warmup=61, draws=50, chains=2)(KEY, normal, normal_data(), options=options),
        "engine": lambda: BlackJAXNUTS(**SHORT)(KEY, normal, normal_data(), options=options),
        "at most 70 steps": lambda: NUTS(warmup=60, draws=10, chains=2)(
            KEY, normal, normal_data(), options=options
        ),
    }
    for reason, attempt in attempts.items():
        with pytest.raises(InputError, match=reason):
            attempt()


def test_a_checkpoint_of_another_version_or_model_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "run.h5"
    options = RunOptions(checkpoint=path, chunk=50, resume=True)
    NUTS(**SHORT)(KEY, normal, normal_data(), options=options)

    def other(noise, y=None):
        level = numpyro.sample("level", dist.Normal(1.0, 2.0))
        with numpyro.plate("row", 12):
            numpyro.sample("y", dist.Normal(level, noise), obs=y)

    other.__name__ = "normal"
    with pytest.raises(InputError, match="expected density"):
        NUTS(**SHORT)(KEY, other, normal_data(), options=options)
    monkeypatch.setattr("dtprob.__version__", "99.0")
    with pytest.raises(InputError, match=r"expected dtprob '99\.0', got '0\.1\.0'"):
        NUTS(**SHORT)(KEY, normal, normal_data(), options=options)
    path.write_text("no checkpoint")
    with pytest.raises(InputError, match="expected an HDF5 file"):
        NUTS(**SHORT)(KEY, normal, normal_data(), options=options)


def test_a_checkpoint_of_a_model_that_reads_something_else_by_now_is_refused():
    """What a model holds besides its data counts as what it computes."""

    class Reading:
        offset = np.zeros(12)

        def __call__(self, y=None):
            level = numpyro.sample("level", dist.Normal(1.0, 3.0))
            with numpyro.plate("row", 12):
                numpyro.sample("y", dist.Normal(level + self.offset, 1.0), obs=y)

    model, data, known = Reading(), {"y": np.ones(12)}, []
    for offset in (0.0, 0.0, 1.0):
        model.offset = np.full(12, offset)
        known.append(identity(*build_target(model, data), NUTS(), KEY))
    assert known[0] == known[1]
    assert known[0]["density"] != known[2]["density"]


def test_without_resume_an_old_checkpoint_is_replaced(tmp_path):
    path = tmp_path / "run.h5"
    NUTS(**SHORT)(KEY, normal, normal_data(), options=RunOptions(checkpoint=path))
    NUTS(**SHORT)(KEY, normal, normal_data(1), options=RunOptions(checkpoint=path))
    again = RunOptions(checkpoint=path, resume=True)
    NUTS(**SHORT)(KEY, normal, normal_data(1), options=again)


def test_progress_is_plain_lines_and_a_status_file(tmp_path, capfd):
    options = RunOptions(progress=True, status_file=tmp_path / "status.json", chunk=30)
    NUTS(**SHORT)(KEY, normal, normal_data(), options=options)
    lines = capfd.readouterr().err.strip().splitlines()
    assert lines[0].startswith("nuts: warmup 30/110")
    assert lines[-1].startswith("nuts: draws 110/110")
    status = json.loads((tmp_path / "status.json").read_text())
    assert (status["done"], status["total"], status["phase"]) == (110, 110, "draws")


def test_stops_early_once_there_is_enough(tmp_path):
    """At a look, which chunks and interruptions do not move; every draw is that of the whole run."""
    data = normal_data()
    whole = NUTS(warmup=100, draws=1000, chains=2)(KEY, normal, data)
    engine = NUTS(warmup=100, draws=1000, chains=2, enough_ess=150, enough_rhat=1.1)
    stopped = engine(KEY, normal, data, options=RunOptions(chunk=70))
    count = stopped.draws_per_chain
    assert count in (200, 400)
    np.testing.assert_array_equal(stopped.draws["level"], whole.draws["level"][:, :count])
    assert summary(stopped).loc["level", "ess"] > 150
    options = RunOptions(chunk=1000, checkpoint=tmp_path / "run.h5", resume=True)
    for _ in range(2):
        assert same(stopped, engine(KEY, normal, data, options=options))
    never = NUTS(warmup=100, draws=300, chains=2, enough_ess=10_000)(KEY, normal, data)
    assert never.draws_per_chain == 300


@pytest.mark.parametrize("kind", ["still", "apart", "no number", "still angle"])
def test_chains_that_stand_still_are_not_enough(kind):
    """Of a constant the effective sample size is the number of draws, and of what is no number it is none."""
    still = np.zeros((2, 400, 1))
    apart = still + np.asarray([0.0, 1.0])[:, None, None]
    positions = {"apart": apart, "no number": np.full_like(still, np.nan)}.get(kind, still)
    if kind == "still angle":
        target, _ = build_target(at_the_cut, at_the_cut_data())
        moving = np.random.default_rng(0).normal(size=still.shape)
        assert Enough(200, 1.1).reached(target, np.concatenate([1e-9 * moving, moving], axis=2))
        positions = np.concatenate([still, moving], axis=2)
    else:
        target, _ = build_target(normal, normal_data())
    assert not Enough(200, 1.1).reached(target, positions)


def test_chunks_grow_where_they_take_no_time(capfd):
    NUTS(warmup=500, draws=1500, chains=1)(KEY, normal, normal_data(), options=RunOptions(progress=True))
    assert len(capfd.readouterr().err.strip().splitlines()) < 12


def test_a_checkpoint_is_written_at_most_once_a_second(tmp_path, monkeypatch):
    """And in any case when the run is done."""
    written = []
    monkeypatch.setattr(checkpoint, "write", lambda *arguments: written.append(arguments))
    monkeypatch.setattr(checkpoint, "SAVE_EVERY", 1e6)
    NUTS(**SHORT)(KEY, normal, normal_data(), options=RunOptions(checkpoint=tmp_path / "run.h5", chunk=10))
    assert [snapshot.done for _, _, snapshot in written] == [110]


def test_silent_by_default(capfd):
    NUTS(**SHORT)(KEY, normal, normal_data())
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("engine", ENGINES)
def test_memory_on_the_device_does_not_grow_with_draws(engine, monkeypatch):
    """Bytes of all live arrays at each report; 100,000 draws with their statistics would be 4.8 MB."""
    report, held = run_module.Progress.report, []

    def reporting(*arguments):
        held.append(sum(array.nbytes for array in jax.live_arrays()))
        report(*arguments)

    monkeypatch.setattr(run_module.Progress, "report", reporting)
    most = []
    for draws in (1_000, 100_000):
        held.clear()
        options = RunOptions(pointwise=False, chunk=1000)
        engine(warmup=50, draws=draws, chains=1)(KEY, normal, normal_data(), options=options)
        most.append(max(held))
    assert most[1] < most[0] + 100_000


def compiled(target):
    """How many programs there are of each compiled function of a target."""
    kept = {handle: getattr(f, "_cache_size", None) for handle, f in target._compiled.items()}
    return {handle: size() for handle, size in kept.items() if size is not None}


@pytest.mark.parametrize("kind", ENGINES)
def test_one_program_for_every_chunk_draw_chain_and_data_set(kind):
    """Chains are advanced by one compiled function, whatever there is of them."""
    run = kind(warmup=60, draws=50, chains=2)
    run(KEY, normal, normal_data())
    target, _ = build_target(normal, normal_data())
    programs = compiled(target)
    for chunk, draws, chains, seed in ((7, 50, 2, 1), (100, 333, 3, 2)):
        engine = kind(warmup=60, draws=draws, chains=chains)
        engine(KEY, normal, normal_data(seed), options=RunOptions(chunk=chunk))
    assert compiled(target) == programs


def test_large_sites_are_left_out_and_named():
    data = normal_data()
    posterior = NUTS(**SHORT)(KEY, normal, data, options=RunOptions(max_entries=1000))
    assert "y" not in posterior.log_likelihood
    assert posterior.provenance["left_out"] == ["y"]


def test_settings_are_checked():
    with pytest.raises(InputError, match="chains of engine nuts: expected 1 or more, got 0"):
        NUTS(chains=0)(KEY, normal, normal_data())
    with pytest.raises(InputError, match="resume"):
        RunOptions(resume=True)
    with pytest.raises(InputError, match="one typed JAX key"):
        NUTS()(jax.random.PRNGKey(0), normal, normal_data())


def test_a_checkpoint_may_be_named_in_words(tmp_path):
    file = str(tmp_path / "run.h5")
    first = NUTS(**SHORT)(KEY, normal, normal_data(), options=RunOptions(checkpoint=file, chunk=10))
    again = NUTS(**SHORT)(
        KEY, normal, normal_data(), options=RunOptions(checkpoint=file, resume=True, chunk=10)
    )
    for name, draws in first.draws.items():
        np.testing.assert_array_equal(again.draws[name], draws)
