"""TOML files as dataclasses: each section one, its values checked by the types of its fields."""

import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, Final, Literal, NewType, cast, get_type_hints

from dtprob.errors import InputError, unknown_name

type Phase = Literal["coherent", "per_packet", "none"]
type Options = Mapping[str, Any]
type Words = Mapping[str, tuple[str, ...]]
"""For each column its words in the order of their numbers, from 0."""
Share = NewType("Share", float)

PHASES: tuple[Phase, ...] = ("coherent", "per_packet", "none")

LARGEST: Final = 2**63 - 1
"""Largest whole number that counts and seeds may be."""


def read_document(path: Path) -> dict[str, Any]:
    """The sections of a TOML file.

    Raises:
        InputError: no such file, a folder, one that may not be read, or not TOML.
    """
    try:
        if path.is_dir():
            inside = sorted(path.glob("*.toml")) or [path / "case.toml"]
            raise InputError(str(path), "a CASE file (TOML)", "a folder", f"Name the file: {inside[0]}")
        if not path.is_file():
            raise InputError(str(path), "a CASE file (TOML)", "no such file", "Check the name and the folder")
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError as error:
        is_toml = path.suffix.lower() == ".toml"
        got = f"another encoding (byte {error.start})" if is_toml else "no text"
        remedy = "Save it as UTF-8" if is_toml else "Name the TOML file, not the data"
        raise InputError(str(path), "a CASE file (TOML), in UTF-8", got, remedy) from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(str(path), "a TOML file", str(error), "Correct the file there") from None
    except OSError as error:
        got = error.strerror or str(error)
        raise InputError(str(path), "a CASE file (TOML)", got, "Check the name and the permissions") from None


def check_seed(seed: int) -> int:
    """A seed that is given instead of the one of a CASE; raises InputError where it cannot be one."""
    if not _is_whole(seed):
        raise InputError("--seed", "a whole number from 0", str(seed), "Give another seed")
    return seed


def parse_sections(document: Mapping[str, Any], path: Path, kinds: Mapping[str, type]) -> dict[str, Any]:
    """Check the sections of a TOML file.

    Args:
        document: the sections as TOML gives them.
        path: where it came from.
        kinds: for each section that can be, the dataclass that it is to become.

    Raises:
        InputError: an unknown section or key, a missing key, or a value of the wrong type or out of range.
    """
    sections: dict[str, Any] = {}
    for name, content in document.items():
        if name not in kinds:
            raise unknown_name(path.name, name, kinds, "section")
        if not isinstance(content, Mapping):
            raise InputError(
                f"{path.name} {name}", f"a section [{name}]", _shown(content), "Write it as a section"
            )
        sections[name] = _section(cast("Mapping[str, Any]", content), kinds[name], f"{path.name} [{name}]")
    return sections


def _section(content: Mapping[Any, Any], kind: type, where: str) -> Any:
    hints = get_type_hints(kind)
    for key in content:
        if key not in hints:
            error = unknown_name(where, key, hints, "key")
            if "options" in hints:
                hint = f"Settings stand under {where.rsplit(maxsplit=1)[-1][:-1]}.options]"
                remedy = f"{error.remedy} {hint}" if error.remedy.endswith("?") else hint
                error = InputError(error.what, error.expected, error.got, remedy)
            raise error
    for entry in fields(kind):
        if entry.name not in content and entry.default is entry.default_factory is MISSING:
            raise InputError(where, f"a key '{entry.name}'", "none", f"Add {entry.name} = ...")
    return kind(**{key: _value(content[key], hints[key], f"{where} {key}") for key in content})


def _value(value: Any, hint: Any, where: str) -> Any:
    expected, accepts = _KINDS[hint]
    if not accepts(value):
        raise InputError(where, expected, _shown(value), "Correct the value")
    return _CONVERT.get(hint, lambda kept: kept)(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= LARGEST


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _is_names(value: Any) -> bool:
    return _is_text(value) or (isinstance(value, list) and all(map(_is_text, cast("list[Any]", value))))


def _are_lists(value: Mapping[str, Any]) -> bool:
    return all(isinstance(listed, list) and _is_names(listed) for listed in value.values())


_KINDS: dict[Any, tuple[str, Any]] = {
    str: ("text", _is_text),
    str | None: ("text", _is_text),
    Path: ("the name of a file", _is_text),
    Path | None: ("the name of a file", _is_text),
    int: ("a whole number from 0", _is_whole),
    int | None: ("a whole number from 1", lambda value: _is_whole(value) and value > 0),
    float | None: ("a positive number", lambda value: _is_number(value) and 0 < value < float("inf")),
    Share: ("a number from 0 to 1", lambda value: _is_number(value) and 0 <= value <= 1),
    bool: ("true or false", lambda value: isinstance(value, bool)),
    str | tuple[str, ...]: ("'all', a list of names, or 'module:name'", _is_names),
    tuple[str, ...]: ("a list of names", lambda value: isinstance(value, list) and _is_names(value)),
    Options: ("a table of settings", lambda value: isinstance(value, Mapping)),
    Words: ("a table of lists of words", lambda value: isinstance(value, Mapping) and _are_lists(value)),
    Phase | None: (f"one of {', '.join(PHASES)}", lambda value: value in PHASES),
}
"""For each type of a field: what it is in words, and the test for it."""

_CONVERT: dict[Any, Any] = {
    Path: Path,
    Path | None: Path,
    float | None: float,
    str | tuple[str, ...]: lambda value: value if isinstance(value, str) else tuple(value),
    tuple[str, ...]: tuple,
    Options: dict,
    Words: lambda value: {name: tuple(listed) for name, listed in value.items()},
}


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
