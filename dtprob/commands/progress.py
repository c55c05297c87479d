"""Telling a person how far a command is: a live line on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

type Say = Callable[[str], None]


@contextmanager
def telling() -> Generator[Say]:
    """Give a function that tells the current step on standard output.

    Yields:
        a function of one line of text; on a terminal the last line spins until the next one or the end.
    """
    start = time.monotonic()
    if not sys.stdout.isatty():
        yield lambda text: print(f"[{time.monotonic() - start:6.1f} s] {text}", flush=True)
        return
    from rich.console import Console  # noqa: PLC0415  (only for terminals)

    console = Console()
    with console.status("starting") as status:

        def say(text: str) -> None:
            console.print(f"[dim]{time.monotonic() - start:6.1f} s[/dim] {text}", highlight=False)
            status.update(text)

        yield say
