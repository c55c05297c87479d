"""Stop when asked to, even where what a signal raises is lost."""

from __future__ import annotations

import signal
import sys
from typing import Any, Final, NoReturn, Self

from dtprob.errors import Terminated

TERMINATED: Final = 143
"""Exit status of a process that was asked to end by SIGTERM."""
_AGAIN: Final = 5.0
"""Seconds after which what was asked for is raised again, and again, unless it has arrived."""


class Stopping:
    """While it is entered, SIGINT and SIGTERM raise `KeyboardInterrupt` and `Terminated` until it is left.

    A signal that is ignored stays so. Python drops what a signal raises inside a callback, as of JAX's garbage collection,
    and JAX makes something else of it inside the comparison of cache keys.

    Attributes:
        asked: the signal that came, if any.
    """

    asked: int | None = None
    _alarm: tuple[Any, tuple[float, float]] | None = None

    def __enter__(self) -> Self:
        """Handle both signals."""
        numbers = (signal.SIGINT, signal.SIGTERM)
        heard = [n for n in numbers if signal.getsignal(n) not in (signal.SIG_IGN, None)]
        self._former = {n: signal.signal(n, self._stop) for n in heard}
        return self

    def __exit__(self, *_: object) -> None:
        """Handle them as before."""
        if self._alarm is not None:
            handler, timer = self._alarm
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, handler)
            signal.setitimer(signal.ITIMER_REAL, *timer)
        for number, handler in self._former.items():
            signal.signal(number, handler)

    def again(self) -> NoReturn:
        """Raise what was asked for."""
        if self.asked == signal.SIGINT:
            raise KeyboardInterrupt
        raise Terminated(TERMINATED)

    def _stop(self, number: int, _: Any) -> None:
        if self.asked is None:
            self.asked = number
            if hasattr(signal, "SIGALRM"):  # Windows has none
                former = signal.signal(signal.SIGALRM, self._remind)
                self._alarm = former, signal.setitimer(signal.ITIMER_REAL, _AGAIN, _AGAIN)
        self.again()

    def _remind(self, *_: object) -> None:
        has_arrived = isinstance(sys.exception(), (KeyboardInterrupt, Terminated))  # and cleans up
        if not has_arrived:
            self.again()
