"""Engines that iterate: interrupted and resumed they end where they would have ended, bit for bit."""

import json
import signal
import subprocess
import sys
import time

import h5py
import jax
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob.errors import InputError
from dtprob.inference import SMC, SVI, Ensemble, Posterior, RunOptions, VonMisesEM
from dtprob.inference import iterate as iterate_module
from tests.unit.inference.examples import at_the_cut, at_the_cut_data, normal, normal_data

KEY = jax.random.key(31)
ENGINES = {
    "svi": SVI(steps=400, draws=20, starts=1, particles=2),
    "smc": SMC(draws=60, chains=2, moves=1, leapfrog=2),
    "von_mises_em": VonMisesEM(draws=20),
    "ensemble": Ensemble(members=70, starts=1),
    "bagging": Ensemble(members=3, base="nuts", settings={"warmup": 20, "draws": 10, "chains": 1}),
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
    assert status["what"] == engine.name
    assert same(whole, engine(KEY, model, data, options=options))  # nothing left to do
    with pytest.raises(InputError, match="data_sha256"):
        engine(KEY, model, {"y": data["y"] + 0.01}, options=options)


KILLED = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
from pathlib import Path
from dtprob.inference import Ensemble, RunOptions
sys.path.insert(0, "tests/unit/inference")
from examples import normal, normal_data
settings = {"draws": 5, "starts": 1}
options = RunOptions(checkpoint=Path(sys.argv[1]), resume=True)
posterior = Ensemble(members=int(sys.argv[2]), base="laplace", settings=settings)(
    jax.random.key(31), normal, normal_data(), options=options
)
posterior.save(sys.argv[3])
"""


def test_killed_without_warning_then_resumed(tmp_path):
    """With an engine whose every step is an engine's run: the loop and the files are those of all that iterate."""
    members = 400
    path, result = tmp_path / "run.h5", tmp_path / "posterior.nc"
    command = [sys.executable, "-c", KILLED, str(path), str(members), str(result)]
    process = subprocess.Popen(command)
    while not path.exists() and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not result.exists()
    with h5py.File(path) as file:
        assert 0 < file.attrs["done"] < members
    subprocess.run(command, check=True)
    engine = Ensemble(members=members, base="laplace", settings={"draws": 5, "starts": 1})
    assert same(engine(KEY, normal, normal_data()), Posterior.load(result))
