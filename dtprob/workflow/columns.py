"""Whether a table has what a model of the user's own takes."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from dtprob.errors import InputError, nearest
from dtprob.models.arguments import Data, Model, lacking
from dtprob.models.indices import check_indices


def check_columns(file: Path, model: Model, arguments: Data, columns: Iterable[str]) -> None:
    """Look for each column that the model cannot do without, for others that are spelt otherwise, and at indices.

    Args:
        file: the table.
        model: the user's own.
        arguments: what it will be given.
        columns: names of the table's columns.

    Raises:
        InputError: a column is missing, empty or spelt otherwise, or an index in one is beyond an array's end.
    """
    there = list(columns)
    for name in lacking(model, arguments):
        close = nearest(name, there)
        remedy = f"Rename {close!r} there" if close else "Add it, or give it under [model.options]"
        raise InputError(file.name, f"a column {name!r}", ", ".join(there) or "none", remedy)
    takes = inspect.signature(model).parameters
    strange = {_plain(name): name for name in there if name not in takes}
    for name in takes:
        spelt = strange.get(_plain(name)) if name not in arguments else None
        if spelt is not None:
            raise InputError(file.name, f"a column {name!r}", repr(spelt), f"Rename {spelt!r} there")
    for name in there:
        if name in takes and np.size(arguments[name]) == 0:
            expected, remedy = "a value or more", "Write what was measured"
            raise InputError(f"{file.name}, column {name!r}", expected, "none", remedy)
    check_indices(model, arguments, f"{file.name}, column")


def _plain(name: str) -> str:
    """A name without what people write in different ways: capitals, what stands between words, and a unit in brackets."""
    return re.sub(r"[(\[].*|[\W_]", "", name).casefold()
