"""The choice of an LLVM library, on files that only look like one."""

import sys

import pytest

from dtprob.errors import InputError
from dtprob.raytracing import llvm
from dtprob.raytracing.llvm import Library, choose_library, find_libraries, prepare_llvm, read_version


def fake(folder, name, symbol=None):
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / name
    file.write_bytes(b"\x7fELF" + b"\0" * 100 + (b"" if symbol is None else b"\0" + symbol + b"\0") + b"rest")
    return file


@pytest.fixture
def clean(monkeypatch):
    """No library named by the user, no Dr.Jit loaded, no GPU."""
    monkeypatch.setenv(llvm.VARIABLE, "")  # so that what a test sets is taken back
    monkeypatch.delenv(llvm.VARIABLE)
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.setattr(llvm, "has_cuda", lambda: False)
    return monkeypatch


@pytest.mark.parametrize(
    ("name", "symbol", "version"),
    [
        ("libLLVM.so.19.1", b"LLVM_19.1", (19, 1)),
        ("libLLVM-14.so.1", b"LLVM_14", (14, 0)),
        ("libLLVM.so", b"LLVM_20.1", (20, 1)),
        ("libLLVM-19.so", b"LLVM_15", (15, 0)),  # the file knows better than its name
        ("libLLVM-18.so", None, (18, 0)),
        ("libLLVM.so.21.1", None, (21, 1)),
        ("libLLVM-14.0.6.so.1", None, (14, 0)),
        ("libLLVM.so", None, None),
    ],
)
def test_version_is_read_without_loading(tmp_path, name, symbol, version):
    assert read_version(fake(tmp_path, name, symbol)) == version


def test_an_empty_file_has_no_version(tmp_path):
    (tmp_path / "libLLVM.so").touch()
    assert read_version(tmp_path / "libLLVM.so") is None


def test_the_newest_good_one_comes_first(tmp_path):
    for name in ("libLLVM-14.so", "libLLVM-15.so", "libLLVM-18.so", "libLLVM-19.so", "libLLVM-22.so"):
        fake(tmp_path, name)
    (tmp_path / "libLLVM.so").symlink_to(tmp_path / "libLLVM-14.so")
    fake(tmp_path, "libLLVM.txt")
    found = find_libraries([tmp_path])
    assert [one.version[0] for one in found] == [22, 19, 18, 15, 14]
    assert [one.verdict for one in found] == ["good", "good", "try", "bad", "bad"]
    assert choose_library(found).version == (22, 0)


@pytest.mark.parametrize("runs", [True, False])
def test_a_doubtful_one_is_tried_in_its_own_process(tmp_path, monkeypatch, runs):
    tried = []
    monkeypatch.setattr(llvm, "works", lambda library: tried.append(library.version) or runs)
    found = find_libraries(
        [fake(tmp_path, "libLLVM-17.so").parent, fake(tmp_path / "b", "libLLVM-16.so").parent]
    )
    chosen = choose_library(found)
    assert tried == [(17, 0)]
    assert (chosen is not None) == runs


def test_a_file_that_is_no_library_does_not_work(tmp_path):
    assert not llvm.works(Library(fake(tmp_path, "libLLVM-18.so"), (18, 0)))


def test_the_choice_is_handed_on(tmp_path, clean):
    file = fake(tmp_path, "libLLVM.so.19.1", b"LLVM_19.1")
    clean.setattr(llvm, "search_path", lambda: (tmp_path,))
    assert prepare_llvm() == file
    assert llvm.os.environ[llvm.VARIABLE] == str(file)


def test_a_named_library_is_kept_or_refused(tmp_path, clean):
    good, bad = fake(tmp_path, "libLLVM-20.so"), fake(tmp_path, "libLLVM-14.so")
    clean.setenv(llvm.VARIABLE, str(good))
    assert prepare_llvm() == good
    clean.setenv(llvm.VARIABLE, str(bad))
    with pytest.raises(InputError, match=r"version 14\.0.*unset DRJIT_LIBLLVM_PATH"):
        prepare_llvm()


def test_none_at_all(tmp_path, clean):
    clean.setattr(llvm, "search_path", lambda: (tmp_path,))
    with pytest.raises(InputError, match=r"got none.*apt-get install libllvm19"):
        prepare_llvm()
    assert llvm.VARIABLE not in llvm.os.environ
    clean.setattr(llvm, "has_cuda", lambda: True)
    assert prepare_llvm() is None


def test_too_late_once_drjit_is_loaded(clean):
    clean.setitem(sys.modules, "drjit", sys)
    assert prepare_llvm() is None
