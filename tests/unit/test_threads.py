"""Linear algebra keeps to one thread unless it is told otherwise."""

import os
import subprocess
import sys

PROGRAM = """
import sys
from dtprob.cli import main
status = main(["doctor"])
import ctypes, numpy, pathlib
library = next(line.split()[-1] for line in open("/proc/self/maps") if "openblas" in line and "numpy" in line)
blas = ctypes.CDLL(library)
names = [n for n in ("scipy_openblas_get_num_threads64_", "openblas_get_num_threads") if hasattr(blas, n)]
print("threads", getattr(blas, names[0])())
"""


def threads(**environment):
    """How many OpenBLAS uses in a process after a command has run."""
    own = {n: v for n, v in os.environ.items() if n not in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, env=own | environment
    )
    return done.stdout.split("threads ")[-1].strip()


def test_one_thread_and_as_many_as_were_asked_for():
    assert threads() == "1"
    assert threads(OPENBLAS_NUM_THREADS="2") == "2"
