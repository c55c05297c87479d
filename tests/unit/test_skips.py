"""On CI a test that misses libLLVM or the measured data fails; elsewhere it is skipped."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = """
import pytest

@pytest.mark.measured
def test_needs_data():
    pytest.skip("no data")

def test_other():
    pytest.skip("for another reason")
"""


@pytest.mark.parametrize(
    ("ci", "failed", "skipped"), [("true", 1, 1), pytest.param("", 0, 2, marks=pytest.mark.study)]
)
def test_missing_means_failure_on_ci(tmp_path, ci, failed, skipped):
    root = Path(__file__).parents[2]
    shutil.copy(root / "tests" / "conftest.py", tmp_path / "conftest.py")
    shutil.copy(root / "pyproject.toml", tmp_path / "pyproject.toml")
    (tmp_path / "test_inner.py").write_text(TESTS)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=tmp_path, env=os.environ | {"CI": ci}
    )
    expected = f"{failed} failed, {skipped} skipped" if failed else f"{skipped} skipped"
    assert expected in done.stdout.splitlines()[-1]
    assert done.returncode == (1 if failed else 0)
