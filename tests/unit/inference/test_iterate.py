"""The loop of engines that carry one state from step to step: interrupted, it ends where it would have ended.

Engines that are killed: test_killed.py.
"""

import json

import jax
import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.inference import SMC, Ensemble, RunOptions, checkpoint
from tests.unit.inference.examples import at_the_cut, at_the_cut_data

KEY = jax.random.key(31)
ENGINES = {
    "smc": SMC(draws=60, chains=2, moves=1, leapfrog=2),
    "ensemble": Ensemble(members=70, starts=1),
    "bagging": Ensemble(members=3, base="nuts", settings={"warmup": 20, "draws": 10, "chains": 1}),
}


class StoppedError(Exception):
    pass


def stop_after(monkeypatch, count):
    """Let the run fail once so many checkpoints are written."""
    write = checkpoint.write
    written = []

    def writing(*arguments):
        write(*arguments)
        written.append(1)
        if len(written) == count:
            raise StoppedError

    monkeypatch.setattr(checkpoint, "write", writing)
    monkeypatch.setattr(checkpoint, "SAVE_EVERY", 0.0)
    monkeypatch.setattr(checkpoint, "_SAVE_SHARE", 0.0)


def same(first, second):
    groups = ("draws", "sample_stats", "extra")
    return all(
        np.array_equal(value, getattr(second, group)[name], equal_nan=value.dtype.kind == "f")
        for group in groups
        for name, value in getattr(first, group).items()
    )


@pytest.mark.parametrize(
    "name", ["ensemble", *(pytest.param(name, marks=pytest.mark.study) for name in ("smc", "bagging"))]
)
def test_an_interrupted_run_continues_as_if_nothing_had_happened(name, tmp_path, monkeypatch):
    engine, data = ENGINES[name], at_the_cut_data()
    whole = engine(KEY, at_the_cut, data)
    options = RunOptions(checkpoint=tmp_path / "run.h5", resume=True, status_file=tmp_path / "status.json")
    with monkeypatch.context() as patch:
        stop_after(patch, 1 if name == "ensemble" else 2)
        with pytest.raises(StoppedError):
            engine(KEY, at_the_cut, data, options=options)
    assert same(whole, engine(KEY, at_the_cut, data, options=options))
    status = json.loads((tmp_path / "status.json").read_text())
    assert status["what"] == engine.name
    assert same(whole, engine(KEY, at_the_cut, data, options=options))  # nothing left to do
    with pytest.raises(InputError, match="data_sha256"):
        engine(KEY, at_the_cut, {"y": data["y"] + 0.01}, options=options)
