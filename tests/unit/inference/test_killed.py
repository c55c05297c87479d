"""Every engine that iterates: killed without warning and resumed, it ends with the bits of a run that was not.

The run that is killed is a process of its own, this module, which kills itself once it has written two checkpoints.
"""

import os
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest

from dtprob.inference import (
    ENGINES,
    HMC,
    NUTS,
    SMC,
    SVI,
    BlackJAXNUTS,
    Ensemble,
    RunOptions,
    VonMisesEM,
    checkpoint,
)

from .examples import at_the_cut, at_the_cut_data, spread_angles, spread_angles_data  # noqa: TID252  (a script too)

UNIT = Path(__file__).parents[1]
KEY = jax.random.key(31)
AT_ONCE = {"auto", "exact", "laplace", "point"}
SHORT = {"warmup": 60, "draws": 50, "chains": 2}
RUNS = {
    "nuts": NUTS(**SHORT),
    "blackjax_nuts": BlackJAXNUTS(**SHORT),
    "hmc": HMC(**SHORT),
    "smc": SMC(draws=60, chains=2, moves=1, leapfrog=2),
    "svi": SVI(steps=240, draws=20, starts=1, particles=2),
    "von_mises_em": VonMisesEM(draws=20),
    "ensemble": Ensemble(members=4, base="laplace", settings={"draws": 5, "starts": 1}),
}
ALIKE = {"blackjax_nuts", "hmc", "smc", "ensemble", "von_mises_em"}
"""Run by the same loops as nuts and svi; `test_iterate` breaks off smc and the ensemble in this process."""


def run(name, **options):
    model, data = at_the_cut, at_the_cut_data()
    if name == "von_mises_em":
        model, data = spread_angles, spread_angles_data()
    return RUNS[name](KEY, model, data, options=RunOptions(chunk=20, **options))


def test_every_engine_that_iterates_is_here():
    assert set(RUNS) == set(ENGINES) - AT_ONCE


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.study) if name in ALIKE else name for name in RUNS]
)
def test_killed_and_resumed_ends_with_the_same_bits(name, tmp_path):
    path = tmp_path / "run.h5"
    process = subprocess.run(
        [sys.executable, "-m", "inference.test_killed", name, str(path)], cwd=UNIT, check=False
    )
    assert process.returncode == -signal.SIGKILL
    with h5py.File(path) as file:
        done = file.attrs["done"]
    whole, resumed = run(name), run(name, checkpoint=path, resume=True)
    with h5py.File(path) as file:
        assert 0 < done < file.attrs["done"]
    for group in ("draws", "sample_stats", "extra"):
        for site, values in getattr(whole, group).items():
            np.testing.assert_array_equal(getattr(resumed, group)[site], values)


def killed(name, path):
    """The run until its second checkpoint."""
    write, written = checkpoint.write, []

    def writing(*arguments):
        write(*arguments)
        written.append(1)
        if len(written) == 2:
            os.kill(os.getpid(), signal.SIGKILL)

    checkpoint.write, checkpoint.SAVE_EVERY, checkpoint._SAVE_SHARE = writing, 0.0, 0.0
    run(name, checkpoint=path)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    killed(sys.argv[1], Path(sys.argv[2]))
