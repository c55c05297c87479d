"""What goes wrong, said so that the reader knows what to do next."""

import difflib
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path


class DtprobError(Exception):
    """Base of all errors that dtprob raises on purpose; its text is one line fit for a user."""


class InputError(DtprobError):
    """Something the user gave is not what was expected.

    The text is always ``<what>: expected <x>, got <y>. <what to do>.``

    Args:
        what: the thing at fault, as the user knows it (a file and key, an argument, an array).
        expected: what would have been right.
        got: what was there.
        remedy: one imperative sentence that says what to do.
    """

    def __init__(self, what: str, expected: str, got: str, remedy: str) -> None:
        self.what = what
        self.expected = expected
        self.got = got
        self.remedy = remedy
        super().__init__(f"{what}: expected {expected}, got {got}. {_sentence(remedy)}")

    def __reduce__(self) -> tuple[type["InputError"], tuple[str, str, str, str]]:
        """Keep the four parts when the error crosses a process boundary."""
        return type(self), (self.what, self.expected, self.got, self.remedy)


class Terminated(SystemExit):
    """The process was asked to end, unlike a user's module that leaves of its own accord."""


def _sentence(text: str) -> str:
    return text if text.endswith((".", "?", "!")) else f"{text}."


def nearest(name: str, valid: Iterable[str]) -> str | None:
    """The valid name that looks most like ``name``, or None when none comes close."""
    candidates = list(valid)
    folded = {candidate.lower(): candidate for candidate in candidates}
    found = difflib.get_close_matches(name.lower(), folded, n=1, cutoff=0.5)
    return folded[found[0]] if found else None


def unknown_name(what: str, name: str, valid: Iterable[str], kind: str = "name") -> InputError:
    """The error for a name that is not among ``valid``; it names the nearest one.

    Args:
        what: where the name stood, for example ``"case.toml [engine] name"``.
        name: the name that was given.
        valid: the names that exist.
        kind: what the names are called, for example ``"engine"``.
    """
    names = sorted(valid)
    close = nearest(name, names)
    remedy = f"Did you mean '{close}'?" if close else f"Use a valid {kind}"
    shown = ", ".join(names) if len(names) <= 16 else ", ".join(names[:16]) + ", ..."
    if not names:
        return InputError(what, f"no {_plural(kind)}", f"'{name}'", "Leave it out")
    return InputError(what, f"one of the {_plural(kind)} {shown}", f"'{name}'", remedy)


def check_choice(what: str, value: object, choices: Iterable[str]) -> None:
    """Refuse a setting that is none of a few words.

    Args:
        what: the setting.
        value: what it was given.
        choices: the words.

    Raises:
        InputError: it is another one; the nearest is named.
    """
    words = list(choices)
    if value not in words:
        raise unknown_name(what, str(value), words, "choice")


def _plural(kind: str) -> str:
    """Several of what ``kind`` names: ``keys``, ``losses``, ``effect families``, ``kinds of traffic``."""
    noun, of, rest = kind.partition(" of ")
    if noun.endswith("y") and noun[-2:-1] not in "aeiou":
        several = f"{noun[:-1]}ies"
    else:
        several = f"{noun}es" if noun.endswith("s") else f"{noun}s"
    return f"{several}{of}{rest}"


def raised_at(error: BaseException) -> str | None:
    """File and line where code that is neither dtprob's nor an installed package's last was when an error came."""
    own = Path(__file__).parent
    installed = tuple(Path(place) for place in (sys.prefix, sys.base_prefix, own))
    found = None
    for frame in traceback.extract_tb(error.__traceback__):
        file = Path(frame.filename)
        if file.is_file() and not any(file.is_relative_to(place) for place in installed):
            found = f"{file.name}, line {frame.lineno}"
    return found
