"""Telling how far a run is: a bar on a terminal, plain lines elsewhere, a status file for other programs."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import Progress as Bar
from rich.progress import TaskID

from dtprob.files import write_text


@dataclass
class Progress:
    """A context that reports steps done; used by run loops only.

    Attributes:
        what: the name of the job.
        total: how many steps it has.
        shown: report on standard error.
        status_file: a JSON file that always holds the latest report.
    """

    what: str
    total: int
    shown: bool = False
    status_file: Path | None = None
    _began: float = field(default_factory=time.monotonic)
    _bar: Bar | None = None
    _task: TaskID | None = None

    def __enter__(self) -> Self:
        """Show the bar, where there is a terminal."""
        console = Console(stderr=True)
        if self.shown and console.is_terminal:
            self._bar = Bar(console=console)
            self._task = self._bar.add_task(self.what, total=self.total)
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()

    def report(self, done: int, phase: str, note: str = "") -> None:
        """Say that `done` steps are done.

        Args:
            done: steps done.
            phase: the part of the job.
            note: what else to say.
        """
        seconds = time.monotonic() - self._began
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, description=f"{self.what} {phase} {note}".rstrip())
        elif self.shown:
            line = f"{self.what}: {phase} {done}/{self.total}, {seconds:.1f} s{', ' + note if note else ''}"
            print(line, file=sys.stderr, flush=True)
        if self.status_file is not None:
            status = {"what": self.what, "phase": phase, "done": done, "total": self.total}
            status |= {"seconds": round(seconds, 3), "note": note}
            write_text(self.status_file, json.dumps(status))
