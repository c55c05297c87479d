"""Telling a person how far a command is: a live line on a terminal, plain lines elsewhere."""

import os
import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

type Say = Callable[[str], None]

SILENCE: Final = 30.0
"""Seconds after which the last step is told again where no line spins."""


@contextmanager
def telling() -> Generator[Say]:
    """Give a function that tells the current step on standard output.

    Yields:
        a function of one line of text; on a terminal the last line spins until the next one or the end.
    """
    start = time.monotonic()
    if sys.stdout is None or not sys.stdout.isatty():  # None where it is closed
        with _repeated(lambda text: _tell(f"[{time.monotonic() - start:6.1f} s] {text}")) as plain_say:
            yield plain_say
        return
    from rich.console import Console  # noqa: PLC0415  (only for terminals)
    from rich.markup import escape  # noqa: PLC0415

    console = Console()
    with console.status("starting") as status:

        def say(text: str) -> None:
            plain = escape(text)  # names such as effect[device_1] are no markup
            console.print(f"[dim]{time.monotonic() - start:6.1f} s[/dim] {plain}", highlight=False)
            status.update(plain)

        yield say


@contextmanager
def _repeated(say: Say) -> Generator[Say]:
    """Say the last step again after each while of silence: no line spins where there is no terminal."""
    step, news, is_over = "", threading.Event(), threading.Event()

    def say_and_remember(text: str) -> None:
        nonlocal step
        step = step if text.startswith("note: ") else text
        say(text)
        news.set()

    def repeat() -> None:
        while not is_over.is_set():
            if news.wait(SILENCE):
                news.clear()
            elif step:
                say(f"still at: {step}")

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield say_and_remember
    finally:
        is_over.set()
        news.set()
        thread.join()


def unread() -> None:
    """Write what is still said on standard output nowhere: its reader has seen enough."""
    with Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())


def _tell(text: str) -> None:
    """Print a line; the work goes on where nobody reads it."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        unread()
