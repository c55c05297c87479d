"""Files that are either there whole or not at all."""

import hashlib
import os
import secrets
import tempfile
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path

from dtprob.errors import InputError


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Generator[Path]:
    """Give a temporary path beside ``path``; on success it replaces ``path`` in one step.

    When the body raises (or the process is killed) ``path`` keeps its earlier content. Missing parent
    directories are made. The temporary path keeps the suffix of ``path``, so that writers which look
    at the suffix choose the same format.

    Args:
        path: the file to write.

    Yields:
        the path that the body writes to; it exists and is empty.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.stem}-{secrets.token_hex(4)}{target.suffix}")
    temporary.touch(exist_ok=False)
    try:
        yield temporary
        _flush(temporary)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write text to a file, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


_held: dict[Path, int] = {}
"""Folders that this process writes results to, each with the open file that keeps other runs out."""


def make_folder(out: Path) -> None:
    """Make the folder of the results, and try to write into it, before work that would be lost without it.

    Other processes are refused it until `let_go`, or the end of this one.

    Raises:
        InputError: a file of that name, no permission, or another run that writes there now.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        expected, got = "a folder that can be written to", error.strerror or str(error)
        raise InputError(f"--out {out}", expected, got, "Choose another folder") from None
    _hold(out)


def let_go() -> None:
    """Let other runs write to the folders that this process has made."""
    while _held:
        os.close(_held.popitem()[1])


def _hold(out: Path) -> None:
    """Keep other processes out of a folder, where the system and the file system can."""
    if os.name == "nt" or out.resolve() in _held:
        return
    import fcntl  # noqa: PLC0415  (Windows has none)

    folder = os.open(out, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(folder)
        expected, got = "a folder that no other run writes to", "one that does"
        raise InputError(f"--out {out}", expected, got, "Wait for it, or choose another folder") from None
    except OSError:  # a file system without locks
        os.close(folder)
        return
    _held[out.resolve()] = folder


def check_apart(out: Path, results: Iterable[str], inputs: Iterable[Path]) -> None:
    """Refuse a folder in which a result would take the place of an input.

    Args:
        out: the folder of the results.
        results: names of the files that will be written there, or removed.
        inputs: the files that are read.

    Raises:
        InputError: such a folder.
    """
    written = {(out / name).resolve(): name for name in results}
    for file in inputs:
        if file.resolve() in written:
            got = f"{written[file.resolve()]}, which is read"
            expected = "a folder where no result takes the place of an input"
            raise InputError(f"--out {out}", expected, got, "Choose another folder")


def sha256(path: Path) -> str:
    """Hash of a file, or of all files of a folder by name, compiled modules left out."""
    digest = hashlib.sha256()
    if not path.is_dir():
        digest.update(path.read_bytes())
        return digest.hexdigest()
    for file in sorted(entry for entry in path.rglob("*") if entry.is_file()):
        if "__pycache__" not in file.parts:
            digest.update(str(file.relative_to(path)).encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _flush(path: Path) -> None:
    """Bring the content to disk before the name points at it."""
    with path.open("rb") as stream:
        os.fsync(stream.fileno())
