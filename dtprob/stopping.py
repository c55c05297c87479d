"""Stop when asked to, even where what a signal raises is lost."""

from __future__ import annotations

import signal
from typing import Any, Final, NoReturn, Self

from dtprob.errors import Terminated

TERMINATED: Final = 143
"""Exit status of a process that was asked to end by SIGTERM."""
_ALARM: Final = (signal.SIGALRM,) if hasattr(signal, "SIGALRM") else ()
"""What reminds of it; Windows has none."""
_AGAIN: Final = 5.0
"""Seconds after which what was asked for is raised again, and again: enough for what cleans up."""


class Stopping:
    """While it is entered, SIGINT and SIGTERM raise `KeyboardInterrupt` and `Terminated` until it is left.

    A signal that is ignored stays so. Python drops what a signal raises inside a callback, as of JAX's garbage collection,
    and JAX makes something else of it inside the comparison of cache keys.

    Attributes:
        asked: the signal that came, if any.
    """

    asked: int | None = None

    def __enter__(self) -> Self:
        """Handle both signals."""
        heard = (n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) is not signal.SIG_IGN)
        self._former = {n: signal.signal(n, self._stop) for n in (*heard, *_ALARM)}
        return self

    def __exit__(self, *_: object) -> None:
        """Handle them as before."""
        self._remind(0.0)
        for number, handler in self._former.items():
            signal.signal(number, handler)

    def again(self) -> NoReturn:
        """Raise what was asked for."""
        if self.asked == signal.SIGINT:
            raise KeyboardInterrupt
        raise Terminated(TERMINATED)

    def _stop(self, number: int, _: Any) -> NoReturn:
        self.asked = number if self.asked is None else self.asked
        self._remind(_AGAIN)
        self.again()

    def _remind(self, seconds: float) -> None:
        if _ALARM:
            signal.setitimer(signal.ITIMER_REAL, seconds, seconds)
