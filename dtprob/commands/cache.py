"""Compiled programs kept between commands, so that the second run on data of the same shapes compiles nothing."""

import hashlib
import os
import platform
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

import jax

LARGEST: Final = 1 << 30
"""Bytes that the folder may hold at the start of a command; what was used longest ago goes first."""


def keep_compiled() -> None:
    """Keep compiled programs in the user's cache folder; JAX_COMPILATION_CACHE_DIR names another one."""
    if jax.config.jax_compilation_cache_dir is not None:
        return
    try:
        folder = cache_folder()
        prune(folder, LARGEST)
    except (OSError, RuntimeError):
        return  # no home, or a folder of another user: compiling again takes time, and no more
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # even small programs: reading one back takes a tenth of compiling it
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def cache_folder() -> Path:
    """A folder of this kind of processor: a home directory may be shared with machines that lack its instructions."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "dtprob" / "compiled" / hashlib.sha256(_processor().encode()).hexdigest()[:12]


def prune(folder: Path, largest: int) -> None:
    """Delete the files of a folder that were used longest ago until the others take at most so many bytes."""
    if not folder.is_dir():
        return
    files = sorted(_files(folder), key=lambda found: max(found[0].st_mtime, found[0].st_atime))
    total = sum(stat.st_size for stat, _ in files)
    for stat, path in files:
        if total > largest:
            Path(path).unlink(missing_ok=True)
            total -= stat.st_size
        elif stat.st_atime > stat.st_ctime:
            _let_note_its_use(stat, path)


def _let_note_its_use(stat: os.stat_result, path: str) -> None:
    """Have the next reading of a file noted: systems note the first after a change, and of the others one a day."""
    with suppress(OSError):
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def _files(folder: Path) -> Iterator[tuple[os.stat_result, str]]:
    """Files of a folder; those that another process prunes meanwhile are left out."""
    for entry in os.scandir(folder):
        with suppress(FileNotFoundError):
            if entry.is_file():
                yield entry.stat(), entry.path


def _processor() -> str:
    """The processor's instructions where the system tells them, else its name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    flags = next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    return f"{platform.machine()} {platform.processor()} {flags}"
