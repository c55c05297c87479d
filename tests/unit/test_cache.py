"""Compiled programs are kept where the user's cache lies, and the oldest go when there are too many."""

import os
import time
from types import SimpleNamespace

import pytest

from dtprob.commands import cache


def test_the_oldest_programs_go_first(tmp_path):
    for age, name in enumerate(["new", "middle", "old"]):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    cache.prune(tmp_path, 250)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["middle", "new"]
    cache.prune(tmp_path, 250)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["middle", "new"]


def test_an_old_program_that_is_still_used_stays(tmp_path):
    for age, name in enumerate(["new", "unused", "used"]):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (1e9 + 9 if name == "used" else 1e9 - age, 1e9 - age))
    cache.prune(tmp_path, 250)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["new", "used"]


def test_the_next_use_of_a_program_is_noted(tmp_path):
    """Systems note when a file was read only where it has changed since the last reading, or that was the day before."""
    file = tmp_path / "used"
    file.write_bytes(bytes(100))
    read = file.stat().st_ctime_ns + 10**8
    os.utime(file, ns=(read, 10**18))
    time.sleep(0.2)
    assert file.stat().st_ctime_ns < read
    cache.prune(tmp_path, 250)
    found = file.stat()
    assert (found.st_atime_ns, found.st_mtime_ns) == (read, 10**18)
    assert found.st_ctime_ns > read


def test_a_folder_that_is_not_there_yet_is_no_error(tmp_path):
    cache.prune(tmp_path / "none", 0)


def test_the_folder_follows_the_user_and_the_processor(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    here = cache.cache_folder()
    assert here.is_relative_to(tmp_path / "dtprob")
    monkeypatch.setattr(cache, "_processor", lambda: "another one")
    assert cache.cache_folder() != here


def test_a_file_that_another_process_deletes_meanwhile_is_no_error(tmp_path, monkeypatch):
    for name in ("kept", "gone"):
        (tmp_path / name).write_bytes(bytes(100))
    entries = list(os.scandir(tmp_path))
    (tmp_path / "gone").unlink()
    monkeypatch.setattr(os, "scandir", lambda _: entries)
    cache.prune(tmp_path, 50)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [PermissionError("of another user"), RuntimeError("no home")])
def test_a_folder_that_cannot_be_used_stops_no_command(monkeypatch, error):
    def missing():
        raise error

    monkeypatch.setattr(cache, "cache_folder", missing)
    monkeypatch.setattr(cache, "jax", SimpleNamespace(config=SimpleNamespace(jax_compilation_cache_dir=None)))
    cache.keep_compiled()
