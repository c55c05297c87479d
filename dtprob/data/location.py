"""Where measured data sets lie; they are never part of the package."""

import os
from pathlib import Path

from dtprob.errors import InputError

MEASURED = ("uwb_apartment",)
"""The measured data sets that can be named where a file is asked for."""


def located(path: Path) -> Path:
    """The path itself, or the folder of a measured data set when nothing is there and its name is one.

    Args:
        path: a file or folder.

    Raises:
        InputError: it is the name of a measured data set that is not there either.
    """
    return measured_data(path.name) if path.name in MEASURED and not path.exists() else path


def measured_data(name: str) -> Path:
    """The folder of a measured data set.

    It is looked for in the folder named by the environment variable DTPROB_DATA, else in ``shared/data``
    beside the checkout.

    Args:
        name: the data set, for example ``"uwb_apartment"``.

    Raises:
        InputError: the folder is not there.
    """
    given = os.environ.get("DTPROB_DATA")
    root = Path(given) if given else Path(__file__).resolve().parents[3] / "shared" / "data"
    folder = root / name
    if not folder.is_dir():
        remedy = "Set DTPROB_DATA to the folder that holds the measured data sets"
        raise InputError(f"measured data '{name}'", f"the folder {folder}", "nothing there", remedy)
    return folder
