"""The guard against a faulty compiler is there where it is needed, and only there."""

import subprocess
import sys

import pytest

from dtprob import xla

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
