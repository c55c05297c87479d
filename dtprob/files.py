"""Files that are either there whole or not at all."""

import hashlib
import os
import secrets
from collections.abc import Generator
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


def make_folder(out: Path) -> None:
    """Make the folder of the results, before work that would be lost without it.

    Raises:
        InputError: a file of that name, or no permission.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"--out {out}", "a folder", error.strerror or str(error), "Choose another folder"
        ) from None


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
