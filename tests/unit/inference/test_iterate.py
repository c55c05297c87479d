"""Engines that iterate: interrupted and resumed they end where they would have ended, bit for bit."""

import json

import jax
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.errors import InputError
from dtprob.inference import SMC, SVI, Ensemble, RunOptions, VonMisesEM
from dtprob.inference import iterate as iterate_module
from tests.unit.inference.examples import at_the_cut, at_the_cut_data

KEY = jax.random.key(31)
ENGINES = {
    "svi": SVI(steps=400, draws=20, starts=1, particles=2),
    "smc": SMC(draws=60, chains=2, moves=1, leapfrog=2),
    "von_mises_em": VonMisesEM(draws=20),
    "ensemble": Ensemble(members=70, starts=1),
}


def spread_angles(y=None):
    """Angles with an unknown common concentration, which von Mises EM finds step by step."""
    concentration = numpyro.sample("concentration", dist.LogNormal(0.0, 1.0))
    with numpyro.plate("angle", 3, dim=-1):
        angle = numpyro.sample("direction", dist.VonMises(0.0, concentration))
        with numpyro.plate("row", 15, dim=-2):
            numpyro.sample("y", dist.VonMises(angle, 1.0), obs=y)


class StoppedError(Exception):
    pass


def stop_after(monkeypatch, count):
    """Let the run fail once so many checkpoints are written."""
    write = iterate_module.checkpoint.write
    written = []

    def writing(*arguments):
        write(*arguments)
        written.append(1)
        if len(written) == count:
            raise StoppedError

    monkeypatch.setattr(iterate_module.checkpoint, "write", writing)
    monkeypatch.setattr(iterate_module, "SAVE_EVERY", 0.0)


def same(first, second):
    groups = ("draws", "sample_stats", "extra")
    return all(
        np.array_equal(value, getattr(second, group)[name], equal_nan=value.dtype.kind == "f")
        for group in groups
        for name, value in getattr(first, group).items()
    )


@pytest.mark.parametrize("name", ENGINES)
def test_an_interrupted_run_continues_as_if_nothing_had_happened(name, tmp_path, monkeypatch):
    engine, data = ENGINES[name], at_the_cut_data()
    model = at_the_cut
    if name == "von_mises_em":
        model, data = spread_angles, {"y": data["y"][:, None] + np.asarray([0.0, 1.0, 2.0])}
    whole = engine(KEY, model, data)
    options = RunOptions(checkpoint=tmp_path / "run.h5", resume=True, status_file=tmp_path / "status.json")
    with monkeypatch.context() as patch:
        stop_after(patch, 1 if name == "ensemble" else 2)
        with pytest.raises(StoppedError):
            engine(KEY, model, data, options=options)
    assert same(whole, engine(KEY, model, data, options=options))
    status = json.loads((tmp_path / "status.json").read_text())
    assert status["what"] == name
    assert same(whole, engine(KEY, model, data, options=options))  # nothing left to do
    with pytest.raises(InputError, match="data_sha256"):
        engine(KEY, model, {"y": data["y"] + 0.01}, options=options)
