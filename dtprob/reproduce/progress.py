"""How a long figure tells where it is, and keeps what it has so that an interrupted run can go on."""

import hashlib
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import numpy as np

from dtprob.files import atomic_write

type Arrays = Mapping[str, np.ndarray]

_SECONDS: Final = "seconds that the part took"


@final
@dataclass(frozen=True)
class Progress:
    """Progress of one figure.

    Attributes:
        say: tells one line of text.
        folder: where finished parts are kept; None keeps none.
    """

    say: Callable[[str], None] = lambda _: None
    folder: Path | None = None

    def part(self, name: str, compute: Callable[[], Arrays]) -> dict[str, np.ndarray]:
        """The arrays of one part of a figure: those of an interrupted run if it got so far, else computed.

        Args:
            name: the part's name, unique within the figure and its settings.
            compute: makes the arrays.
        """
        self.say(name)
        if self.folder is None:
            return dict(compute())
        file = self.folder / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.npz"
        if file.is_file():
            with np.load(file, allow_pickle=False) as stored:
                return {key: stored[key] for key in stored.files if key != _SECONDS}
        start = time.monotonic()
        arrays = dict(compute())
        seconds = {_SECONDS: np.asarray(time.monotonic() - start)}
        with atomic_write(file) as path:
            np.savez_compressed(path, allow_pickle=False, **arrays, **seconds)
        return arrays

    def spent(self) -> float:
        """Seconds that the finished parts of an interrupted run took; what it lost is not known."""
        files = [] if self.folder is None else sorted(self.folder.glob("*.npz"))
        total = 0.0
        for file in files:
            with np.load(file, allow_pickle=False) as stored:
                total += float(stored[_SECONDS])
        return total

    def done(self) -> None:
        """Forget the parts: the figure is written."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)
