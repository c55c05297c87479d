"""Choose the LLVM library that the ray tracer compiles with, before anything loads one.

Dr.Jit opens the first libLLVM that it meets. Some versions make it fail with a misleading message, others
abort the process, so the version is read from the file itself, without loading it, and the choice is handed
to Dr.Jit through its environment variable DRJIT_LIBLLVM_PATH.
"""

import mmap
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from dtprob.errors import InputError

VARIABLE: Final = "DRJIT_LIBLLVM_PATH"
CONFIRMED: Final = 19
"""The oldest version known to work; 17 and 18 are tried in a process of their own."""
DOUBTFUL: Final = 17
INSTALL: Final = "apt-get install libllvm19"

type Verdict = Literal["good", "try", "bad", "unknown"]

_PLACES: Final = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/lib/llvm-*/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
_NAME: Final = re.compile(r"libLLVM[^/]*?[-.](?:so\.)?(\d+)(?:\.(\d+))?")
_SYMBOL: Final = re.compile(rb"\0LLVM_(\d+)(?:\.(\d+))?\0")
_PROBE: Final = (
    "import drjit as dr, drjit.llvm as d; x = d.Float([1.0, 2.0]) + 1; dr.eval(x); assert x[1] == 3"
)


@dataclass(frozen=True)
class Library:
    """One LLVM library on this machine.

    Attributes:
        path: the file, links resolved.
        version: major and minor version, or None when the file does not tell.
    """

    path: Path
    version: tuple[int, int] | None

    @property
    def verdict(self) -> Verdict:
        """Whether Dr.Jit works with it: good, bad, worth a try, or unknown."""
        if self.version is None:
            return "unknown"
        major = self.version[0]
        return "good" if major >= CONFIRMED else "try" if major >= DOUBTFUL else "bad"


def search_path() -> tuple[Path, ...]:
    """Folders in which systems keep shared libraries, those named by the user first."""
    named = os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    prefixes = [Path(prefix) / "lib" for prefix in (os.environ.get("CONDA_PREFIX"), sys.prefix) if prefix]
    places = [found for place in _PLACES for found in sorted(Path("/").glob(place.lstrip("/")))]
    return tuple(
        folder for folder in [*map(Path, filter(None, named)), *prefixes, *places] if folder.is_dir()
    )


def read_version(path: Path) -> tuple[int, int] | None:
    """Version of an LLVM library, from the version of its symbols or else from its name; never loads it."""
    try:
        with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
            match = _SYMBOL.search(content)
            parts = tuple(int(part or 0) for part in match.groups()) if match else None
    except (OSError, ValueError):
        return None
    if parts is None:
        named = _NAME.search(path.name)
        parts = tuple(int(part or 0) for part in named.groups()) if named else None
    return None if parts is None else (parts[0], parts[1])


def find_libraries(folders: Iterable[Path] | None = None) -> list[Library]:
    """The LLVM libraries in some folders, the best for Dr.Jit first.

    Args:
        folders: where to look; when None the library named in DRJIT_LIBLLVM_PATH if there is one, otherwise
            those of `search_path`.
    """
    named = os.environ.get(VARIABLE)
    if folders is None and named:
        return [Library(Path(named), read_version(Path(named)))]
    chosen = search_path() if folders is None else folders
    names = {found.resolve() for folder in chosen for found in folder.glob("libLLVM*") if found.is_file()}
    libraries = [
        Library(path, read_version(path)) for path in names if ".so" in path.name or ".dylib" in path.name
    ]
    rank = {"good": 0, "try": 1, "unknown": 2, "bad": 3}
    return sorted(libraries, key=lambda one: (rank[one.verdict], _newest_first(one), str(one.path)))


def _newest_first(library: Library) -> tuple[int, int]:
    major, minor = library.version or (0, 0)
    return (-major, -minor)


def choose_library(libraries: Sequence[Library]) -> Library | None:
    """The first library that works; a doubtful one is tried in a process of its own."""
    usable = (one for one in libraries if one.verdict == "good" or (one.verdict != "bad" and works(one)))
    return next(usable, None)


def works(library: Library) -> bool:
    """Whether Dr.Jit compiles and runs a kernel with this library, tried in a process of its own."""
    environment = {**os.environ, VARIABLE: str(library.path)}
    command = [sys.executable, "-c", _PROBE]
    none = subprocess.DEVNULL
    try:
        done = subprocess.run(  # noqa: S603 (our own text)
            command, env=environment, timeout=120, check=False, stdin=none, stdout=none, stderr=none
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def has_cuda() -> bool:
    """Whether there is an NVIDIA GPU, which the ray tracer prefers and which needs no LLVM."""
    return Path("/dev/nvidia0").exists() or Path("/dev/dxg").exists()


def prepare_llvm() -> Path | None:
    """Point Dr.Jit at a good LLVM library; call it before sionna-rt is first imported.

    A library that the user named in DRJIT_LIBLLVM_PATH is kept if it is not known to be bad.

    Returns:
        the library, or None where a GPU makes it needless or Dr.Jit is loaded already.

    Raises:
        InputError: no usable library is there, and no GPU.
    """
    if "drjit" in sys.modules:
        return None
    libraries = find_libraries()
    chosen = choose_library(libraries)
    if chosen is None:
        if has_cuda():
            return None
        raise _missing(libraries, os.environ.get(VARIABLE))
    os.environ[VARIABLE] = str(chosen.path)
    return chosen.path


def _missing(libraries: Sequence[Library], named: str | None) -> InputError:
    described = [f"{one.path} (version {'.'.join(map(str, one.version or '?'))})" for one in libraries]
    where = f"LLVM library named in {VARIABLE}" if named else "LLVM library for the ray tracer"
    remedy = f"Install one, on Debian with `{INSTALL}`" + (f", and unset {VARIABLE}" if named else "")
    return InputError(where, f"version {CONFIRMED} or newer", ", ".join(described) or "none", remedy)
