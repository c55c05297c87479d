"""Models and effects of the user's own, named "package.module:function"."""

import importlib
import importlib.util
import sys
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from dtprob.errors import InputError, Terminated, unknown_name


def load_object(name: str, folder: Path) -> Any:
    """What "package.module:name" names; this runs the module.

    A module beside the CASE file comes before one that is installed.

    Args:
        name: module and attribute.
        folder: where to look for the module first.

    Raises:
        InputError: a malformed name, no such module, a module that does not run, or no such attribute (the
            nearest one is named).
    """
    module_name, _, attribute = name.partition(":")
    parts = module_name.split(".")
    if not attribute.isidentifier() or not all(part.isidentifier() for part in parts):
        remedy = "Write the module and the function, for example 'my_model:model'"
        raise InputError(name, "'package.module:function'", f"'{name}'", remedy)
    module = _load_module(module_name, parts, folder)
    if not hasattr(module, attribute):
        public = [entry for entry in vars(module) if not entry.startswith("_")]
        raise unknown_name(f"module {module_name}", attribute, public, "name")
    return getattr(module, attribute)


def source_files(names: Iterable[str], folder: Path) -> list[Path]:
    """The files of the modules that have been loaded for some names: these, and what lies in the folder and they import.

    Args:
        names: as given to `load_object`.
        folder: the one given there.
    """
    named, own = {name.partition(":")[0] for name in names}, folder.resolve()
    files: set[Path] = set()
    if not named:
        return []
    for name, module in list(sys.modules.items()):
        file = Path(getattr(module, "__file__", None) or "").resolve()
        is_beside = file.is_relative_to(own) and not file.is_relative_to(sys.prefix)
        if file.is_file() and (name in named or is_beside):
            files.add(file)
    return sorted(files)


def _load_module(name: str, parts: list[str], folder: Path) -> ModuleType:
    beside = folder.joinpath(*parts)
    is_beside = beside.with_suffix(".py").is_file() or (beside / "__init__.py").is_file()
    with _importable_from(folder):
        if is_beside:
            _forget(parts[0], folder)
        elif _find(name) is None:
            expected = f"a module beside the CASE file ({'/'.join(parts)}.py) or one that is installed"
            remedy = "Check the name and the folder"
            if parts[-1] == "py":
                remedy = f"Name the module without .py: '{name[:-3]}:...'"
            raise InputError(f"module {name}", expected, "none of that name", remedy)
        try:
            return importlib.import_module(name)
        except Terminated:
            raise
        except (Exception, SystemExit) as error:
            got = f"{type(error).__name__}: {str(error).splitlines()[0].rstrip('.') if str(error) else ''}"
            raise InputError(f"module {name}", "a module that runs", got, "Correct the module") from error


def _find(name: str) -> object:
    try:
        return importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None


def _forget(named: str, folder: Path) -> None:
    """Drop modules that another folder's took the names of: the one named, and those that it may import from beside."""
    beside = {file.stem for file in folder.glob("*.py")} | {
        file.parent.name for file in folder.glob("*/__init__.py")
    }
    for top in beside:
        loaded = sys.modules.get(top)
        if loaded is None or _lies_in(loaded, folder) or (top != named and _is_installed(loaded)):
            continue
        for name in [entry for entry in sys.modules if entry == top or entry.startswith(f"{top}.")]:
            del sys.modules[name]
    importlib.invalidate_caches()


def _is_installed(module: ModuleType) -> bool:
    """Whether a module is Python's own or a package's, and not one beside another CASE."""
    return not _places(module) or any(_lies_in(module, Path(own)) for own in (sys.prefix, sys.base_prefix))


def _lies_in(module: ModuleType, folder: Path) -> bool:
    return any(Path(place).is_relative_to(folder) for place in _places(module))


def _places(module: ModuleType) -> list[str]:
    places = [getattr(module, "__file__", None) or "", *getattr(module, "__path__", [])]
    return [place for place in places if place]


@contextmanager
def _importable_from(folder: Path) -> Generator[None]:
    """Let modules in ``folder`` be imported, for the time of one import."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
