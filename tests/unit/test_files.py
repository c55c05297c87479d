"""A file is there whole or not at all."""

import os
import stat
import subprocess
import sys

import pytest

from dtprob.files import atomic_write, let_go, make_folder


def test_replaces_in_one_step(tmp_path):
    target = tmp_path / "sub" / "a.json"
    with atomic_write(target) as temporary:
        assert temporary.suffix == ".json"
        temporary.write_text("1")
        assert not target.exists()
    assert target.read_text() == "1"
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(target.stat().st_mode) == 0o666 & ~mask


def test_failure_keeps_what_was_there(tmp_path):
    target = tmp_path / "a.json"
    target.write_text("old")

    def fail():
        with atomic_write(target) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such locks")
def test_two_runs_do_not_write_to_one_folder(tmp_path):
    """The second would mix its results with those of the first."""
    program = (
        "import sys, pathlib; from dtprob.files import make_folder; make_folder(pathlib.Path(sys.argv[1]))"
    )
    other = [sys.executable, "-c", program, str(tmp_path / "out")]
    make_folder(tmp_path / "out")
    make_folder(tmp_path / "out")  # a command in steps
    refused = subprocess.run(other, capture_output=True, text=True, check=False)
    assert "expected a folder that no other run writes to, got one that does." in refused.stderr
    let_go()
    subprocess.run(other, check=True)
    make_folder(tmp_path / "out")  # the other one has ended
    let_go()
