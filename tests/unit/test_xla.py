"""The guard against a faulty compiler is there where it is needed, and only there."""

import os
import subprocess
import sys
import warnings

import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest

from dtprob import xla
from dtprob.inference.build import build_target

PROGRAM = """
from dtprob import xla
if {guarded}:
    xla.avoid_miscompilation()
print(xla.miscompiles())
"""


def test_flag_is_added_once_and_beside_others(monkeypatch):
    monkeypatch.setattr(xla, "FAULTY", frozenset({xla.version()}))
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    xla.avoid_miscompilation()
    xla.avoid_miscompilation()
    assert xla.os.environ["XLA_FLAGS"] == f"--xla_cpu_enable_fast_math=false {xla.FLAG}"


def test_other_versions_are_left_alone(monkeypatch):
    monkeypatch.setattr(xla, "FAULTY", frozenset())
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    xla.avoid_miscompilation()
    assert "XLA_FLAGS" not in xla.os.environ


@pytest.mark.parametrize("flagged", [False, True])
def test_what_infers_warns_where_the_flag_is_missing(flagged, monkeypatch):
    monkeypatch.setattr(xla, "FAULTY", frozenset({xla.version()}))
    monkeypatch.setenv("XLA_FLAGS", xla.FLAG if flagged else "")
    data = {"y": np.zeros(3)}
    for _ in range(2):
        xla.warn_of_miscompilation.cache_clear()
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            build_target(normal, data)
            build_target(normal, data)
        assert len([w for w in told if "export XLA_FLAGS" in str(w.message)]) == (0 if flagged else 1)


def normal(y=None):
    numpyro.sample("y", dist.Normal(numpyro.sample("mean", dist.Normal(0.0, 1.0)), 1.0).expand([3]), obs=y)


def test_tests_themselves_run_on_a_sound_compiler():
    assert not xla.miscompiles()


@pytest.mark.parametrize("guarded", [False, True])
def test_the_fault_is_real_and_the_flag_avoids_it(guarded, monkeypatch):
    if xla.version() not in xla.FAULTY:
        pytest.skip("this version of jaxlib is not known to be faulty")
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    program = PROGRAM.format(guarded=guarded)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(not guarded)


@pytest.mark.parametrize("late", [False, True])
def test_configure_is_in_time_or_says_that_it_is_not(late):
    program = f"""
import warnings
import jax
if {late}:
    jax.numpy.ones(3)
import dtprob, dtprob.xla
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    dtprob.configure()
print(jax.config.jax_enable_x64, dtprob.xla.miscompiles(), len(told))
"""
    environment = {n: v for n, v in os.environ.items() if n != "XLA_FLAGS"}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment
    )
    faulty = late and xla.version() in xla.FAULTY
    assert done.stdout.split() == ["True", str(faulty), str(int(faulty))]
